"""Rejects captures that circle an object: a room is filmed from inside.

Shapes: N cameras, P points.
"""

import numpy as np

from nerf2real.scenes.alignment.lines import nearest_point

_INWARD = np.cos(np.radians(25.0))  # of the optical axis to the way to the common focus
_SHARE = 0.9  # of the cameras that look inward, and of the points inside their ring
_WIDEST_GAP = np.radians(120.0)  # between neighbouring cameras of a ring, seen from its focus


class NoRoomError(ValueError):
  """The pictures show a thing from all sides and no room; the message is one line."""


def circles_a_thing(world_from_camera: np.ndarray, points: np.ndarray) -> bool:
  """Whether cameras [N, 4, 4] stand around nearly all points [P, 3] and look inward; z is up."""
  if not len(points):
    return False
  focus = nearest_point(world_from_camera[:, :3, 3], world_from_camera[:, :3, 2])
  way = focus - world_from_camera[:, :3, 3]
  distance = np.linalg.norm(way, axis=-1)
  inward = (way * world_from_camera[:, :3, 2]).sum(-1) > _INWARD * distance
  angles = np.sort(np.arctan2(-way[:, 1], -way[:, 0]))
  gap = np.diff(np.r_[angles, angles[0] + 2 * np.pi]).max()
  inside = np.linalg.norm(points - focus, axis=-1) < np.percentile(distance, 25)
  return bool(inward.mean() > _SHARE and inside.mean() > _SHARE and gap < _WIDEST_GAP)


def require_room(world_from_camera: np.ndarray, points: np.ndarray) -> None:
  """Raises NoRoomError where the cameras circle a thing.

  Args:
    world_from_camera: Poses [N, 4, 4], upright frame.
    points: Localised points [P, 3].
  """
  if circles_a_thing(world_from_camera, points):
    raise NoRoomError(
      f"The {len(world_from_camera)} pictures circle one thing, and {_SHARE:.0%} of what they show "
      "lies within the ring of cameras; expected a room around the cameras: film it from inside, "
      "its floor included. If this is a room after all, give floor_points in the override file."
    )
