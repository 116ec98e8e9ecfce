"""The field's ablation: what stands in pictures is in the share asked for, and in no others."""

import numpy as np

from benchmarks.rooms import field_ablation
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field.views import Views


def test_passers_stand_in_a_share_of_the_pictures():
  camera = Camera.from_vertical_fov(1.0, 64, 48)
  images = np.zeros((40, 48, 64, 3), np.uint8)
  views = Views(camera, images, np.tile(np.eye(4), (40, 1, 1)), tuple(map(str, range(40))))
  painted = field_ablation.with_passers(views, 0.5, 0).images.any((1, 2, 3))
  assert 8 < painted.sum() < 32
  assert not images.any()


def test_who_waits_stands_at_one_place_in_pictures_in_a_row():
  camera = Camera.from_vertical_fov(1.0, 64, 48)
  poses = np.tile(np.eye(4), (20, 1, 1))
  poses[:, 0, 3] = np.linspace(-0.2, 0.2, 20)  # the camera passes by
  anchors = np.array([(i, 32, 24, 2.0) for i in range(20)], np.float32)
  images = np.zeros((20, 48, 64, 3), np.uint8)
  views = Views(camera, images, poses, tuple(map(str, range(20))), anchors=anchors)
  painted = field_ablation.with_waiting(views, 0.5, 0).images.any(-1)
  shown = np.flatnonzero(painted.any((1, 2)))
  assert len(shown) == 10 and (np.diff(shown) == 1).all()
  middle = [np.flatnonzero(painted[i].any(0)).mean() for i in shown]
  drift = np.polyfit(poses[shown, 0, 3], middle, 1)[0]
  # A metre to the right moves what is 2 m away by half the focal length to the left.
  assert -1.2 * camera.fx / 2 < drift < -0.8 * camera.fx / 2


def test_the_sharper_half_counts_more():
  camera = Camera.from_vertical_fov(1.0, 64, 48)
  images = np.zeros((4, 48, 64, 3), np.uint8)
  images[:] = np.arange(4)[:, None, None, None]
  anchors = np.array([(i, 32, 24, 2.0 + i) for i in range(4)], np.float32)
  views = Views(camera, images, np.tile(np.eye(4), (4, 1, 1)), tuple("abcd"), anchors=anchors)
  found = field_ablation.by_sharpness(views, {"a": 0.5, "b": 3.0, "c": 2.0, "d": 0.7})
  assert found.names == tuple("aaabcddd")
  assert [image.max() for image in found.images[found.anchors[:, 0].astype(int)]] == [0, 1, 2, 3]
