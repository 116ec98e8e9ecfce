"""Where a walker that pushes a ball to a target has to walk: behind the ball, then through it.

The ball is pushed from the side opposite to the target where a robot fits there, and else, as at a
wall, from the place nearest to it around the ball.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerf2real.suite.gaits.planner import Planner


@dataclasses.dataclass(frozen=True, kw_only=True)
class PushSettings:
  """Geometry of a push; chosen: it moved the ball in simulation."""

  behind: float = 0.30
  """m behind the ball's centre from where it is pushed."""
  lane: float = 0.06
  """m beside the line of the push within which a push begins; it ends at twice that."""
  clearance: float = 0.30
  """m from the ball's centre that a way around it keeps: the radii of ball (0.12 m) and robot."""
  overshoot: float = 0.4
  """m beyond the ball at which a pushing robot aims."""
  headings: int = 24
  """Directions of a whole turn; those up to a quarter of it from the target's are tried."""
  stickiness: float = 0.5
  """Weight of the robot's bearing from the ball, beside the target's, in the choice of a direction:
  a smaller way around is worth a less direct push."""


class Way(NamedTuple):
  """Where to walk."""

  point: np.ndarray
  """[2] m: the place to push from, or the point beyond the ball to aim at."""
  pushes: bool
  """Whether it leads through the ball."""


def _angle(vector: np.ndarray) -> float:
  return float(np.arctan2(vector[1], vector[0]))


def _wrap(angle: np.ndarray) -> np.ndarray:
  return (angle + np.pi) % (2 * np.pi) - np.pi


class Push:
  """The next way of a robot that pushes a ball."""

  def __init__(self, planner: Planner, settings: PushSettings):
    self._planner, self._settings = planner, settings
    self.reset()

  def reset(self) -> None:
    """Begins an episode: the robot does not push."""
    self._pushing = False

  def way(self, robot: np.ndarray, ball: np.ndarray, target: np.ndarray) -> Way:
    """Returns where a robot [2] has to walk to bring a ball [2] to a target [2] [m]."""
    s = self._settings
    direction = self._direction(robot, ball, target)
    aside = np.array([-direction[1], direction[0]])
    offset = robot - ball
    along, lateral = float(offset @ direction), float(offset @ aside)
    lane = s.lane * (2.0 if self._pushing else 1.0)
    self._pushing = -2 * s.behind < along < -0.05 and abs(lateral) < lane
    if self._pushing:
      # Beyond the ball and back on the line: what is left of the offset is steered away.
      return Way(ball + s.overshoot * direction - lateral * aside, True)
    return Way(ball - s.behind * direction, False)

  def path(self, robot: np.ndarray, ball: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Returns points [N, 2] from a robot to a place, around a ball (each [2]) [m]."""
    return self._planner.path(robot, place, around=ball, clearance=self._settings.clearance)

  def _direction(self, robot: np.ndarray, ball: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns the unit vector [2] of the best push that a robot can stand behind."""
    s = self._settings
    wanted, present = _angle(target - ball), _angle(ball - robot)
    angles = wanted + np.linspace(-np.pi / 2, np.pi / 2, s.headings // 2 + 1)
    directions = np.stack([np.cos(angles), np.sin(angles)], -1)
    cost = np.abs(_wrap(angles - wanted)) + s.stickiness * np.abs(_wrap(angles - present))
    cost = cost + np.where(self._planner.is_free(ball - s.behind * directions), 0.0, 2 * np.pi)
    return directions[int(np.argmin(cost))]
