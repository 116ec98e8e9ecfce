"""One draw a trajectory; ranges; translations by whole pixels."""

import jax
import numpy as np

from nerf2real.agents.dmpo import augmentation
from nerf2real.agents.dmpo.config import AugmentationConfig

CONFIG = AugmentationConfig()


def _images(seed=0, batch=3, time=4):
  rng = np.random.default_rng(seed)
  # Smooth colours, the same picture at every time step of a trajectory.
  picture = rng.uniform(0.2, 0.8, (batch, 1, 20, 40, 3)).astype(np.float32)
  return np.repeat(picture, time, axis=1)


def test_same_draw_within_a_trajectory_and_another_between():
  images = np.repeat(_images()[:1], 3, axis=0)  # the same picture in all trajectories
  out = np.asarray(augmentation.augment(jax.random.key(0), images, CONFIG))
  for trajectory in out:
    for t in range(1, 4):
      np.testing.assert_array_equal(trajectory[t], trajectory[0])
  assert np.abs(out[0, 0] - out[1, 0]).max() > 0.02
  assert np.abs(out[0, 0] - images[0, 0]).max() > 0.02
  assert out.min() >= 0 and out.max() <= 1


def test_disabled_changes_nothing():
  images = _images()
  out = augmentation.augment(jax.random.key(0), images, AugmentationConfig(enabled=False))
  np.testing.assert_array_equal(out, images)


def test_brightness_alone_stays_in_range_and_is_uniform():
  config = AugmentationConfig(hue=0.0, contrast=(1, 1), saturation=(1, 1), translation=0.0)
  images = np.full((200, 1, 2, 2, 3), 0.5, np.float32)
  out = np.asarray(augmentation.augment(jax.random.key(1), images, config))[:, 0, 0, 0, 0] - 0.5
  assert np.abs(out).max() <= 32 / 255 + 1e-5
  assert np.abs(out).max() > 0.9 * 32 / 255
  assert abs(out.mean()) < 0.03


def test_translation_reaches_5_percent_and_repeats_the_edge():
  ramp = np.broadcast_to(np.arange(40, dtype=np.float32)[None, None, :, None], (2, 20, 40, 3))
  shifts = set()
  for seed in range(40):
    out = np.asarray(augmentation.translate(jax.random.key(seed), ramp, 0.05))
    shift = int(out[0, 0, 20, 0]) - 20
    shifts.add(shift)
    expected = np.clip(np.arange(40) + shift, 0, 39)
    np.testing.assert_array_equal(out[0, 0, :, 0], expected)
    np.testing.assert_array_equal(out[1], out[0])
  assert shifts == {-2, -1, 0, 1, 2}
