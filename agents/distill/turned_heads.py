"""Recorded episodes with the head's tilt where a teacher has it: pictures rendered anew.

A head is light: what the legs did stays true when it looks elsewhere. So data of a teacher that
held its head otherwise, students' own paths included, serve the teacher of now.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.specs import BALL, JOINTS, POSITION, ROTATION, Layout
from nerf2real.suite import specs
from nerf2real.suite.op3 import constants

TILT = constants.JOINT_NAMES.index("head_tilt")
# Of the way to its target that a servo goes in a control step: a first-order lag, damping / gain.
_SHARE = 1 - np.exp(-constants.CONTROL_TIMESTEP * constants.POSITION_GAIN / constants.JOINT_DAMPING)


class TurnedHead:
  """The tilt of an episode's head as a teacher drives it, step by step, and what it sees.

  Joint readings and pictures are a control step late, as they are on average.
  """

  def __init__(self, task: Any, layout: Layout, episode: Mapping[str, np.ndarray]):
    """Begins at the episode's first step.

    Args:
      task: of ball pushing, with a camera; its ball is moved.
      layout: of the environment that the episode was collected in.
      episode: its recorded arrays.
    """
    self._task, self._rows = task, episode["privileged"]
    names = (POSITION, ROTATION, BALL, JOINTS)
    self._columns = {name: layout.privileged_column(name) for name in names}
    lower, upper = constants.joint_limits()
    self._middle, self._half_range = (lower + upper)[TILT] / 2, (upper - lower)[TILT] / 2
    self._angle = float(self._read(0, JOINTS, TILT + 1)[TILT])
    self._control = (self._angle - self._middle) / self._half_range
    self._angles = np.full(specs.HISTORY, self._angle)
    self._controls = np.full(specs.HISTORY, self._control)

  def _read(self, step: int, name: str, size: int) -> np.ndarray:
    column = self._columns[name]
    assert column is not None
    return self._rows[step, column : column + size].astype(np.float64)

  def show(self, observation: Mapping[str, np.ndarray]) -> None:
    """Writes the tilt's histories into an observation."""
    observation["joint_positions"][:, TILT] = self._angles
    observation["previous_control"][:, TILT] = self._controls

  def picture(self, step: int) -> np.ndarray:
    """Returns what is seen at a step, uint8 [H, W, 3]."""
    seen = max(0, step - 1)
    joints = self._read(seen, JOINTS, len(constants.JOINT_NAMES))
    joints[TILT] = self._angles[-1]
    ball = self._read(seen, BALL, 3)
    self._task.put_ball(ball[:2], height=ball[2])
    return self._task.picture_of(
      position=self._read(seen, POSITION, 3),
      rotation=self._read(seen, ROTATION, 9).reshape(3, 3),
      joints=joints,
    )

  def follow(self, action: np.ndarray) -> float:
    """Moves the head by an action [20] on to the next step; returns the tilt's part of it."""
    own = float(action[TILT])
    self._control = constants.ACTION_FILTER * self._control + (1 - constants.ACTION_FILTER) * own
    self._angles = np.append(self._angles[1:], self._angle)
    self._controls = np.append(self._controls[1:], self._control)
    self._angle += _SHARE * (self._middle + self._half_range * self._control - self._angle)
    return own
