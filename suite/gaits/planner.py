"""Paths over a scene's free floor, for the scripted walker. Nothing of this is seen by a policy."""

from typing import Any

import numpy as np

_CELL = 0.05  # edge of a cell of the planner's grid [m]
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
    self._floor = scene.free_space.grid(scene.extent, _CELL)
    near = _NEAR * np.maximum(0.0, 1.0 - self._floor.clearance / _COMFORT)
    self._cost = np.where(self._floor.free, 1.0 + near, _BLOCKED)

  def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Returns points [N, 2] from start [2] to goal [2], both included [m]."""
    return self._floor.path(start, goal, self._cost)

  def is_clear(self, start: np.ndarray, end: np.ndarray) -> bool:
    """Returns whether the straight line between two places keeps the comfortable distance."""
    count = max(2, int(np.linalg.norm(np.subtract(end, start)) / (_CELL / 2)))
    line = np.linspace(start, end, count)
    return bool((self._cost[self._floor.index_of(line)] < 1.0 + 0.5 * _NEAR).all())
