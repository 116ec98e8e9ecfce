"""Finds the point nearest to lines."""

import numpy as np


def nearest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
  """The point [3] nearest to lines, by least squares; of parallel ones the one nearest to zero.

  Args:
    origins: Of the lines [K, 3].
    directions: Unit vectors along them [K, 3].
  """
  across = np.eye(3) - directions[:, :, None] * directions[:, None]
  right = np.einsum("kij,kj->i", across, origins)
  point: np.ndarray = np.linalg.lstsq(across.sum(0), right, rcond=None)[0]
  return point
