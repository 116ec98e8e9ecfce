"""A room that needs no renderer: a box seen from inside, colours a formula of the point hit."""

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field.field import FieldSettings
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import Views

HALF_SIZE = 0.8  # the walls are at +-0.8 units
TRAINING = TrainSettings(
  field=FieldSettings(log2_table_size=12, growth=1.3, march_step=0.03),
  max_steps=300,
  max_seconds=None,
  batch_samples=1 << 14,
  inner_cells=32,
  outer_cells=16,
  occupancy_samples=1 << 13,
  occupancy_start=96,
  occupancy_sweep_steps=160,
  blur_max=1.0,
  warmup_steps=16,
)
"""Seconds of training that show the box."""


def wall_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
  """Distance [...] to the wall along unit directions [..., 3] from origins [..., 3] inside."""
  with np.errstate(divide="ignore"):
    to_walls = (np.sign(directions) * HALF_SIZE - origins) / directions
  return to_walls.min(-1)


def wall_color(points: np.ndarray) -> np.ndarray:
  """Colours [..., 3] in [0, 1] of points on the walls [..., 3]."""
  return 0.5 + 0.4 * np.sin(points * [9.0, 11.0, 13.0] + [0.0, 1.0, 2.0])


def _directions(camera: Camera, pose: np.ndarray) -> np.ndarray:
  """Unit directions [H, W, 3] of a picture's pixels."""
  rays = camera.rays() @ pose[:3, :3].T
  return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def rays(views: Views, index: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns origin [3] and unit directions [H, W, 3] of a picture's pixels in the unit frame."""
  pose = views.world_from_camera[index]
  return pose[:3, 3], _directions(views.camera, pose)


def make_views(
  count: int, *, width: int = 32, height: int = 24, seed: int = 0, anchors: int = 0
) -> Views:
  """Films the box from inside with random turns; `anchors` pixels a picture know their distance."""
  camera = Camera(
    width=width, height=height, fx=0.8 * width, fy=0.8 * width, cx=width / 2, cy=height / 2, k1=0.03
  )
  rng = np.random.default_rng(seed)
  images, poses, known = [], [], [np.zeros((0, 4), np.float32)]
  for _ in range(count):
    forward = rng.normal(size=3) * [1, 1, 0.4]
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[:3, 3] = rng.uniform(-0.4, 0.4, 3)
    rays = _directions(camera, pose)
    hits = pose[:3, 3] + wall_distance(pose[:3, 3], rays)[..., None] * rays
    images.append(np.rint(255 * wall_color(hits)).astype(np.uint8))
    poses.append(pose)
    x, y = rng.integers(0, width, anchors), rng.integers(0, height, anchors)
    distances = wall_distance(pose[:3, 3], rays[y, x])
    known.append(
      np.stack([np.full(anchors, len(poses) - 1), x, y, distances], -1, dtype=np.float32)
    )
  names = tuple(f"{i:04d}" for i in range(count))
  return Views(camera, np.stack(images), np.stack(poses), names, anchors=np.concatenate(known))
