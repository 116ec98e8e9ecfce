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

  def path(
    self,
    start: np.ndarray,
    goal: np.ndarray,
    *,
    around: np.ndarray | None = None,
    clearance: float = 0.0,
  ) -> np.ndarray:
    """Returns points [N, 2] from start [2] to goal [2], both included [m].

    Args:
      start: Where the path begins.
      goal: Where it ends.
      around: A place [2] to keep away from, such as a ball's; None: there is none.
      clearance: The distance that is kept from it [m].
    """
    cost = self._cost
    if around is not None:
      near = np.linalg.norm(self._floor.centres - around, axis=-1) < clearance
      cost = np.where(near, _BLOCKED, cost)
    return self._floor.path(start, goal, cost)

  def is_free(self, places: np.ndarray) -> np.ndarray:
    """Returns whether the robot fits at places [..., 2], bool [...]."""
    return self._floor.free[self._floor.index_of(places)]
