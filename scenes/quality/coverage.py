"""Coverage of a room's floor and walls by posed pictures, without any reconstruction.

A place is covered when enough pictures show it finely enough to triangulate it. What stands in the
way is not known before a field is trained, so furniture hides nothing here: coverage is an upper
bound. Shapes: N cameras, P places.
"""

from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry.cameras import Camera

_CELL = 0.2  # distance of places [m]
_FINEST = 0.01  # m that a pixel may span at a place: contact geometry is wanted to 5 cm
_FEWEST_VIEWS = 3  # two triangulate, the third confirms
_STEEPEST = 0.17  # least cosine of incidence: at 80 degrees a surface is a line
_FIELD_OF_VIEW = 1.5  # tangent; farther out a lens polynomial may fold back into the picture
_WALL_HEIGHTS = (0.2, 0.6, 1.0)  # of places on walls [m]: what a robot's camera looks at


class Coverage(NamedTuple):
  """Places on a room's floor and walls, and which of them are covered."""

  floor: np.ndarray  # [P, 3] m
  floor_covered: np.ndarray  # bool [P]
  walls: np.ndarray  # [P, 3] m
  walls_covered: np.ndarray  # bool [P]

  @property
  def shares(self) -> tuple[float, float]:
    """Covered share of the floor and of the walls."""
    return float(self.floor_covered.mean()), float(self.walls_covered.mean())


def views_of(
  places: np.ndarray, normals: np.ndarray, camera: Camera, world_from_camera: np.ndarray
) -> np.ndarray:
  """Counts the pictures [P] that show places [P, 3] with unit normals [P, 3] finely enough."""
  count = np.zeros(len(places), np.int64)
  reach = _FINEST / camera.pixel_angle
  for pose in world_from_camera:
    away = pose[:3, 3] - places
    local = -away @ pose[:3, :3]
    distance = np.linalg.norm(away, axis=-1)
    good = (local[:, 2] > 1e-3) & (distance < reach)
    good &= (away * normals).sum(-1) > _STEEPEST * distance
    good &= (np.abs(local[:, :2]) < _FIELD_OF_VIEW * local[:, 2:]).all(-1)
    index = np.flatnonzero(good)
    pixel = camera.project(local[index])
    inside = ((pixel >= 0) & (pixel < [camera.width, camera.height])).all(-1)
    count[index[inside]] += 1
  return count


def coverage(
  camera: Camera, world_from_camera: np.ndarray, extent: tuple[np.ndarray, np.ndarray]
) -> Coverage:
  """Judges floor and walls of a box.

  Args:
    camera: Of all pictures.
    world_from_camera: Poses [N, 4, 4], world frame: metres, z up, floor at z = 0.
    extent: Lower and upper corner of the room [>= 2] [m].
  """
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
  steps = [max(2, int(np.ceil(size / _CELL))) for size in upper - lower]
  x, y = (
    low + (np.arange(count) + 0.5) * (high - low) / count
    for low, high, count in zip(lower, upper, steps, strict=True)
  )
  flat = np.stack(np.meshgrid(x, y, [0.0], indexing="ij"), -1).reshape(-1, 3)
  up = np.broadcast_to([0.0, 0.0, 1.0], flat.shape)
  walls, inward = [], []
  for axis, along in ((0, y), (1, x)):
    for border, sign in ((lower[axis], 1.0), (upper[axis], -1.0)):
      place = np.empty((len(along) * len(_WALL_HEIGHTS), 3))
      place[:, axis] = border
      place[:, 1 - axis] = np.repeat(along, len(_WALL_HEIGHTS))
      place[:, 2] = np.tile(_WALL_HEIGHTS, len(along))
      normal = np.zeros_like(place)
      normal[:, axis] = sign
      walls.append(place)
      inward.append(normal)
  around, facing = np.concatenate(walls), np.concatenate(inward)
  return Coverage(
    flat,
    views_of(flat, up, camera, world_from_camera) >= _FEWEST_VIEWS,
    around,
    views_of(around, facing, camera, world_from_camera) >= _FEWEST_VIEWS,
  )
