"""Normal equations of the poses of all pictures and of their lens.

Poses change by small turns about the world's origin and shifts. Shapes: N pictures, L numbers of
the lens.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.least_squares import cauchy_weights
from nerf2real.scenes.poses.depth.lens import LENS
from nerf2real.scenes.poses.depth.residuals import Rows

_WIDE = 2.0  # deviations from which a residual counts less


class System:
  """Gauss-Newton's equations, summed up row by row."""

  def __init__(self, count: int):
    """Begins with nothing.

    Args:
      count: Pictures N.
    """
    self._count = count
    self._blocks = np.zeros((count, count, 6, 6))
    self._slope = np.zeros((count, 6))
    self._beside = np.zeros((count, 6, len(LENS)))
    self._lens = np.zeros((len(LENS), len(LENS)))
    self._lens_slope = np.zeros(len(LENS))

  def add(self, rows: Rows, spread: float, worth: float) -> None:
    """Adds residuals of two pictures with the Cauchy loss.

    Args:
      rows: The residuals.
      spread: Their deviation, in those that they were expected to have.
      worth: Independent observations that they are at most: their errors go together.
    """
    by_pose = np.hstack([np.cross(rows.point, rows.direction), rows.direction])
    root = cauchy_weights(rows.size, _WIDE * spread) / (spread * rows.expected)
    root = root[:, None] * np.sqrt(min(1.0, worth / len(root)))
    moving, lens, residual = root * by_pose, root * rows.by_lens, root[:, 0] * rows.residual
    square, slope, beside = moving.T @ moving, moving.T @ residual, moving.T @ lens
    i, j = rows.first, rows.second
    self._blocks[i, i] += square
    self._blocks[j, j] += square
    self._blocks[i, j] -= square
    self._blocks[j, i] -= square
    self._slope[i] += slope
    self._slope[j] -= slope
    self._beside[i] += beside
    self._beside[j] -= beside
    self._lens += lens.T @ lens
    self._lens_slope += lens.T @ residual

  def hold(self, poses: np.ndarray, came: np.ndarray, shift: float, turn: float) -> None:
    """Holds poses [N, 4, 4] at those that came, which are off by so much [m] and [rad]."""
    off = np.hstack([turns_between(poses, came) / turn, (poses - came)[:, :3, 3] / shift])
    for row, place in enumerate(poses[:, :3, 3]):
      by_pose = np.zeros((6, 6))
      by_pose[:3, :3] = np.eye(3) / turn
      by_pose[3:, :3] = -np.cross(np.eye(3), place) / shift
      by_pose[3:, 3:] = np.eye(3) / shift
      self._blocks[row, row] += by_pose.T @ by_pose
      self._slope[row] += by_pose.T @ off[row]

  def hold_lens(self, off: np.ndarray, deviations: np.ndarray) -> None:
    """Holds the lens, off [L] so many of its deviations [L]."""
    self._lens += np.diag(deviations**-2.0)
    self._lens_slope += off / deviations

  def step(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns turns [N, 3, 3], shifts [N, 3] [m] and the lens' change [L]."""
    size = 6 * self._count
    whole = np.empty((size + len(LENS), size + len(LENS)))
    whole[:size, :size] = self._blocks.transpose(0, 2, 1, 3).reshape(size, size)
    whole[:size, size:] = self._beside.reshape(size, -1)
    whole[size:, :size] = whole[:size, size:].T
    whole[size:, size:] = self._lens
    moved = -np.linalg.solve(whole, np.concatenate([self._slope.ravel(), self._lens_slope]))
    poses = moved[:size].reshape(-1, 6)
    return Rotation.from_rotvec(poses[:, :3]).as_matrix(), poses[:, 3:], moved[size:]


def turns_between(poses: np.ndarray, other: np.ndarray) -> np.ndarray:
  """Returns rotation vectors [N, 3] [rad] from other poses [N, 4, 4] to these."""
  return Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(other[:, :3, :3], 1, 2)).as_rotvec()
