"""Settings of the robot's environment, and what a task needs of it."""

import dataclasses

import numpy as np

from nerf2real.real.safety.monitor import SafetySettings
from nerf2real.real.wire.bus import BusSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobotSettings:
  """Settings of the robot."""

  bus: BusSettings = dataclasses.field(default_factory=BusSettings)
  """The bus and the servos' registers."""
  safety: SafetySettings = dataclasses.field(default_factory=SafetySettings)
  """Limits beyond which the torque goes off."""
  chip_low_pass: bool = True
  """The IMU chip filters by itself; False: filtered here."""
  settle_time: float = 2.5
  """s between being let go and the start of an episode."""
  rest_time: float = 1.0
  """s at the end of it in which the gyroscope's zero is measured."""
  grip_time: float = 1.0
  """s between being taken hold of and the first move."""
  dry_run: bool = False
  """Reads everything and writes nothing to the servos: nothing moves."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSpec:
  """A task on the robot: what the policy observes and how long an episode is."""

  goals: np.ndarray
  """The scene's goals [G, 2] [m]; the first is set."""
  goal_lower: np.ndarray
  """Lower corner of the floor [2] [m]."""
  goal_upper: np.ndarray
  """Upper corner of the floor [2] [m]."""
  time_limit: float
  """Length of an episode [s]."""
  image_size: tuple[int, int] | None
  """(height, width) of the policy's picture; None without a camera."""
  head_pan_limit: float | None = None
  """Limit of the head pan, +- rad; None: the paper's table."""
