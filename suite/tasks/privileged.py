"""Privileged observations, for the critic alone: true poses and velocities, the episode's draws."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import NUM_DRAWS, EpisodeDraws
from nerf2real.suite.tasks.state import RobotState

PREFIX = "privileged/"
_JOINTS = len(constants.JOINT_NAMES)


class Quantity(NamedTuple):
  """A vector of the simulation's truth."""

  size: int
  read: Callable[[], np.ndarray]


def of_robot(
  state: Callable[[], RobotState],
  *,
  goal: Callable[[], np.ndarray],
  draws: Callable[[], EpisodeDraws | None],
) -> dict[str, Quantity]:
  """Returns what both tasks give, by name. Velocities are in the gravity-aligned frame.

  Args:
    state: Returns the robot's true state.
    goal: Returns the goal in the world [2] [m].
    draws: Returns the episode's random draws; None before the first episode.
  """

  def drawn() -> np.ndarray:
    found = draws()
    return np.zeros(NUM_DRAWS) if found is None else found.vector()

  return {
    "robot_position": Quantity(3, lambda: state().position),
    "robot_rotation": Quantity(9, lambda: state().rotation.ravel()),
    "robot_velocity": Quantity(3, lambda: state().velocity @ state().aligned),
    "robot_angular_velocity": Quantity(3, lambda: state().angular_velocity @ state().aligned),
    "joint_positions": Quantity(_JOINTS, lambda: state().joints),
    "joint_velocities": Quantity(_JOINTS, lambda: state().joint_velocities),
    "goal": Quantity(2, lambda: state().relative(goal())),
    "randomisation": Quantity(NUM_DRAWS, drawn),
  }
