"""The 3 x 3 m workspace of ball pushing: where it lies in a scene."""

import dataclasses
from typing import Any

import numpy as np

from nerf2real.scenes.geometry.free_space import FreeSpace
from nerf2real.suite import protocols

_STEP = 0.1  # m between the places that are tried, and between the points that are counted
_PLACE_GRID = 0.05  # m between the places that a start blocked by furniture may move to
_MIN_FREE = 0.25  # least share of the workspace that is free; chosen


@dataclasses.dataclass(frozen=True)
class Workspace:
  """A square along the world's axes, of 3 x 3 cells; the target is one of its corner cells."""

  center: np.ndarray
  """[2] m."""

  @property
  def lower(self) -> np.ndarray:
    """Lower corner [2] [m]."""
    return self.center - protocols.WORKSPACE_SIZE / 2

  @property
  def upper(self) -> np.ndarray:
    """Upper corner [2] [m]."""
    return self.center + protocols.WORKSPACE_SIZE / 2

  @property
  def target(self) -> np.ndarray:
    """Centre of the target cell [2] [m]."""
    return self.center + np.array(protocols.TARGET_CELL) * protocols.CELL_SIZE

  def contains(self, xy: np.ndarray) -> bool:
    """Returns whether a point [2] lies in the workspace."""
    return bool(((xy >= self.lower) & (xy <= self.upper)).all())

  def in_target(self, xy: np.ndarray) -> bool:
    """Returns whether a point [2] lies in the target cell."""
    return bool((np.abs(xy - self.target) <= protocols.CELL_SIZE / 2).all())

  def places(self) -> np.ndarray:
    """Returns a grid of places over the workspace [N, 2] [m]."""
    side = np.arange(0, protocols.WORKSPACE_SIZE, _PLACE_GRID) + _PLACE_GRID / 2
    return self.lower + np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)

  def starts(
    self, trial: protocols.BallTrial, free_space: FreeSpace
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns where robot [2] and ball [2] start in a trial [m].

    Where furniture stands in the way, that is the nearest free place.
    """
    places = self.places()
    robot = free_space.nearest_reachable(self.center + trial.robot_xy, places)
    ball = free_space.nearest_reachable(self.center + trial.ball_xy, places)
    return robot, ball


def _window_sums(values: np.ndarray, size: int) -> np.ndarray:
  """Returns sums over all size x size windows of an array."""
  table = np.pad(np.cumsum(np.cumsum(values, 0), 1), ((1, 0), (1, 0)))
  return table[size:, size:] - table[:-size, size:] - table[size:, :-size] + table[:-size, :-size]


def find_workspace(scene: Any) -> Workspace:
  """Finds the place where most of the workspace, and of its target cell, is free floor.

  Args:
    scene: A bundle: its `extent` and `free_space` are used.

  Raises:
    ValueError: The scene is smaller than the workspace, or too full.
  """
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in scene.extent)
  size = protocols.WORKSPACE_SIZE
  if (upper - lower < size).any():
    raise ValueError(
      f"Ball pushing needs a workspace of {size:g} x {size:g} m, found a scene of "
      f"{upper[0] - lower[0]:.2f} x {upper[1] - lower[1]:.2f} m: use a larger scene."
    )
  floor = scene.free_space.grid(scene.extent, _STEP)
  free = floor.free.astype(float)
  cells = round(size / _STEP)
  target_cells = round(protocols.CELL_SIZE / _STEP)
  whole = _window_sums(free, cells) / cells**2
  # The target cell's window starts so many points after the workspace's.
  shift = [
    round((size / 2 + (c - 0.5) * protocols.CELL_SIZE) / _STEP) for c in protocols.TARGET_CELL
  ]
  target = _window_sums(free, target_cells) / target_cells**2
  target = target[shift[0] :, shift[1] :][: whole.shape[0], : whole.shape[1]]
  best = np.unravel_index(np.argmax(whole + target), whole.shape)
  if whole[best] < _MIN_FREE:
    raise ValueError(
      f"Ball pushing needs a workspace of {size:g} x {size:g} m with at least {_MIN_FREE:.0%} free "
      f"floor, found {whole[best]:.0%} at best: use a scene with more room."
    )
  return Workspace(floor.centres[best] - _STEP / 2 + size / 2)
