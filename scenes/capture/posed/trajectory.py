"""Trajectories of stamped poses, interpolated at the times of pictures.

Source of the format: Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems: time,
position and quaternion (x, y, z, w) a line. Shapes: N times, T poses.
"""

import numpy as np
from scipy.spatial.transform import Rotation

SAME_TIME = 0.02  # s between a picture and its pose or depth; as in TUM's own tools
_LONGEST_GAP = 0.1  # s between poses that are interpolated: a hand's motion is smooth for so long


def nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Index of the nearest of `times` [T] for each wanted time [N], and whether it is near enough."""
  order = np.argsort(times, kind="stable")
  right = np.clip(np.searchsorted(times[order], wanted), 1, max(len(times) - 1, 1))
  left = right - 1
  right = np.minimum(right, len(times) - 1)
  earlier = wanted - times[order[left]] < times[order[right]] - wanted
  index = order[np.where(earlier, left, right)]
  return index, np.abs(times[index] - wanted) <= SAME_TIME


def poses_at(rows: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Interpolates a trajectory: positions linearly, rotations along the shortest arc.

  Args:
    rows: float [T, 8]: time [s], position [m], quaternion; what is not finite or no rotation does
      not count.
    wanted: Times [N] [s].

  Returns:
    Poses [N, 4, 4] and whether each is known [N]: the trajectory has a pose within `SAME_TIME`, or
    poses before and after it that are near each other.
  """
  sound = np.isfinite(rows).all(-1) & (np.linalg.norm(rows[:, 4:8], axis=-1) > 0.5)
  rows = rows[sound]
  rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
  matrices = np.tile(np.eye(4), (len(wanted), 1, 1))
  if not len(rows):
    return matrices, np.zeros(len(wanted), bool)
  times = rows[:, 0]
  right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
  left = np.clip(right - 1, 0, None)
  gap = times[right] - times[left]
  share = np.clip((wanted - times[left]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
  share = np.where(gap <= _LONGEST_GAP, share, np.round(share))
  between = (gap <= _LONGEST_GAP) & (times[left] <= wanted) & (wanted <= times[right])
  known = between | nearest(times, wanted)[1]
  before, after = Rotation.from_quat(rows[left, 4:8]), Rotation.from_quat(rows[right, 4:8])
  arc = (before.inv() * after).as_rotvec()
  matrices[:, :3, :3] = (before * Rotation.from_rotvec(share[:, None] * arc)).as_matrix()
  matrices[:, :3, 3] = rows[left, 1:4] + share[:, None] * (rows[right, 1:4] - rows[left, 1:4])
  return matrices, known
