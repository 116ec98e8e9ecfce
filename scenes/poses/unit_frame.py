"""Finds the unit frame: upright, centred, as large as the sparse points and the cameras need.

Shapes: N cameras, P points.
"""

import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.core.geometry.similarity import Similarity

POINT_FRACTION = 0.98  # of the points inside [-1, 1]^3; the rest are outliers and far views
CAMERA_MARGIN = 1.05  # cameras stay this factor away from the cube's faces
_BOX_PERCENTILES = (1.0, 99.0)  # of the points, for the robust centre
_YAW_STEPS = 180  # half degrees of a quarter turn that are tried
# The first camera's heading, once turned, lies from here to a quarter turn more. People film along
# walls and into corners: both ends keep away from multiples of 45 degrees.
_QUARTER_START = -np.pi / 8
_LEVEL = 0.5  # length of a level axis' horizontal part
_UPRIGHT = 0.1  # length of the mean up vector below which up is unknown


def mean_up(world_from_camera: np.ndarray) -> np.ndarray:
  """Up direction of cameras [N, 4, 4]: a unit vector [3], see `rotations.level_up`.

  Where the cameras' ups cancel (a camera that rolls over), the direction in which the positions
  spread least is up.
  """
  poses = np.asarray(world_from_camera, np.float64)
  up = -poses[:, :3, 1].mean(axis=0)
  if np.linalg.norm(up) < _UPRIGHT:
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    least = np.linalg.svd(centred, full_matrices=False)[2][-1]
    return least if least @ up >= 0 else -least
  return rotations.level_up(poses, up)


def _heading(rotation: np.ndarray, pose: np.ndarray) -> float:
  """Angle [rad] about z of a camera's right axis in the upright frame.

  A camera carried by hand keeps that axis level, wherever it looks. Where it is steep, the angle is
  that of the view.
  """
  axes = rotation @ pose[:3, :3]
  level = np.hypot(axes[0], axes[1])
  x, y = axes[:2, 0 if level[0] > _LEVEL else 2]
  return float(np.arctan2(y, x))


def _yaw_of_smallest_box(points: np.ndarray, heading: float) -> np.ndarray:
  """Rotation [3, 3] about z after which the points' box, robustly, covers the smallest area.

  A box is the same after a quarter turn. Of its four yaws the one is taken that brings the heading
  between `_QUARTER_START` and a quarter turn more. The yaws that are tried count from the heading
  too, so that the result does not depend on the frame that the points are given in.
  """
  best, smallest = np.inf, 0.0
  for angle in np.linspace(0, np.pi / 2, _YAW_STEPS, endpoint=False) + _QUARTER_START - heading:
    cosine, sine = np.cos(angle), np.sin(angle)
    x = cosine * points[:, 0] - sine * points[:, 1]
    y = sine * points[:, 0] + cosine * points[:, 1]
    low_x, high_x = np.percentile(x, _BOX_PERCENTILES)
    low_y, high_y = np.percentile(y, _BOX_PERCENTILES)
    area = (high_x - low_x) * (high_y - low_y)
    if area < best:
      best, smallest = area, angle
  return rotations.yaw_matrix(smallest)


def unit_from_source(world_from_camera: np.ndarray, points: np.ndarray) -> Similarity:
  """Chooses the unit frame.

  Up is as the cameras are held, yaw makes the room's box small (walls along the axes),
  with the first camera's right axis near +x, the origin is the middle of that box, and the unit is
  such that 98 % of the points and all cameras lie in [-1, 1]^3. All of it follows from the capture:
  the frame that poses and points are given in does not matter.

  Args:
    world_from_camera: Poses in the source's frame [N, 4, 4], in the order of the pictures' names.
    points: Sparse points in the source's frame [P, 3]; without any, the cameras span the box and
      half of it is left around them.
  """
  poses = np.asarray(world_from_camera, np.float64)
  centres = poses[:, :3, 3]
  everything = np.concatenate([np.asarray(points, np.float64).reshape(-1, 3), centres])
  rotation = rotations.rotation_to_up(mean_up(poses))
  heading = _heading(rotation, poses[0])
  rotation = _yaw_of_smallest_box(everything @ rotation.T, heading) @ rotation
  turned, cameras = everything @ rotation.T, centres @ rotation.T
  low, high = np.percentile(turned, _BOX_PERCENTILES, axis=0)
  centre = 0.5 * (low + high)
  radius = CAMERA_MARGIN * np.abs(cameras - centre).max()
  if len(points):
    distances = np.abs(turned[: len(points)] - centre).max(axis=1)
    radius = max(radius, float(np.quantile(distances, POINT_FRACTION)))
  else:
    radius *= 2
  scale = 1 / max(radius, 1e-9)
  return Similarity(float(scale), rotation, -scale * centre)
