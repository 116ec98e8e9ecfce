"""Paths over a scene's free floor, for the scripted walker. Nothing of this is seen by a policy."""

from typing import Any

import numpy as np
from scipy import ndimage
from skimage import graph

_CELL = 0.05  # m of the planner's grid: ours
_BLOCKED = 60.0  # cost of a cell where the robot does not fit, against 1 far from everything
_NEAR = 4.0  # cost added beside an obstacle; it falls off over `_COMFORT`
_COMFORT = 0.25  # m


class Planner:
  """Shortest comfortable paths between two places of a scene."""

  def __init__(self, scene: Any):
    """Samples the scene's free space on a grid.

    Args:
      scene: A bundle: its `extent` and `free_space` are used.
    """
    lower, upper = (np.asarray(corner, np.float64)[:2] for corner in scene.extent)
    self._origin = lower
    x, y = (np.arange(lower[i] + _CELL / 2, upper[i], _CELL) for i in range(2))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    free = np.asarray(scene.free_space.is_reachable(points.reshape(-1, 2)), bool)
    self._free = free.reshape(points.shape[:2])
    clearance = ndimage.distance_transform_edt(np.pad(self._free, 1))[1:-1, 1:-1] * _CELL
    near = _NEAR * np.maximum(0.0, 1.0 - clearance / _COMFORT)
    self._cost = np.where(self._free, 1.0 + near, _BLOCKED)

  def _cell(self, xy: np.ndarray) -> tuple[int, int]:
    index = np.floor((np.asarray(xy, np.float64) - self._origin) / _CELL).astype(int)
    row, column = np.clip(index, 0, np.array(self._cost.shape) - 1)
    return int(row), int(column)

  def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Returns points [N, 2] from start [2] to goal [2], both included [m]."""
    cells, _ = graph.route_through_array(
      self._cost, self._cell(start), self._cell(goal), fully_connected=True, geometric=True
    )
    points = self._origin + _CELL * (np.array(cells) + 0.5)
    points[0], points[-1] = start, goal
    return points

  def is_clear(self, start: np.ndarray, end: np.ndarray) -> bool:
    """Returns whether the straight line between two places keeps the comfortable distance."""
    count = max(2, int(np.linalg.norm(np.subtract(end, start)) / (_CELL / 2)))
    line = np.linspace(start, end, count)
    costs = np.array([self._cost[self._cell(point)] for point in line])
    return bool((costs < 1.0 + 0.5 * _NEAR).all())
