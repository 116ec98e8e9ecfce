"""Drivers of an environment that is shown: a standing robot, random motions, a scripted walker.

Learned policies come from `evaluation.policies.driving`, with the same protocol.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from nerf2real.core.floor_map import Extent
from nerf2real.suite.gaits.walker import Walker
from nerf2real.suite.op3 import constants

if TYPE_CHECKING:
  from nerf2real.suite.tasks.base import RobotTask

STAND, RANDOM, WALKER = "stand", "random", "walker"
_SPREAD = 0.5  # standard deviation of random actions
_REST = 1.0  # s at a goal before the next one


class Driver(Protocol):
  """Gives the actions of an episode."""

  def restart(self) -> None:
    """Begins an episode, whose first observation is the next one."""

  def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the next action [20]."""

  def density(self, extent: Extent) -> np.ndarray | None:
    """Returns where it expects to be, density [1/m^2] on a grid as `FloorMap.heat`; or None."""


MakeDriver = Callable[[Any], Driver]
"""Makes the driver of a task whose model is compiled."""


class Standing:
  """Holds the reference pose."""

  def __init__(self, task: "RobotTask"):
    self._action = task.standing_action

  def restart(self) -> None:
    """Does nothing: there is no state."""

  def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    return self._action

  def density(self, extent: Extent) -> np.ndarray | None:
    return None


class Random(Standing):
  """Moves randomly about the reference pose."""

  def __init__(self, task: "RobotTask", *, seed: int = 0):
    super().__init__(task)
    self._rng = np.random.default_rng(seed)

  def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    noise = self._rng.normal(0, _SPREAD, self._action.shape)
    return np.clip(self._action + noise, -1, 1).astype(np.float32)


class Walking:
  """The scripted walker: to the goal, or pushing the ball; its pose is given to it."""

  def __init__(self, task: "RobotTask"):
    """Takes the task; one with a ball has a workspace with a target."""
    self._task: Any = task
    pushes = hasattr(task, "workspace")
    self._walker = Walker(
      task.scene, head_pan_limit=constants.BALL_PUSHING_HEAD_PAN if pushes else None
    )
    self._pushes = pushes
    self.restart()

  def restart(self) -> None:
    self._walker.reset(self._task.state.pose)

  def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    task = self._task
    goal = task.workspace.target if self._pushes else task.goal
    ball = task.ball_position if self._pushes else None
    return self._walker.act(observation, goal=goal, pose=task.state.pose, ball=ball)

  def density(self, extent: Extent) -> np.ndarray | None:
    return None


SCRIPTED: dict[str, MakeDriver] = {WALKER: Walking, STAND: Standing, RANDOM: Random}
"""Drivers that need no training, by name."""


def move_on(task: Any) -> None:
  """Gives the next goal a second after one was reached, where the task has several."""
  outcome = task.outcome
  rested = outcome.success and outcome.duration > outcome.success_time + _REST
  if rested and hasattr(task, "next_goal"):
    task.next_goal()
