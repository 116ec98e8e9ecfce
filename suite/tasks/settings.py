"""Settings that both tasks take."""

import dataclasses
import math
from collections.abc import Sequence

from nerf2real.suite.effects import Effect
from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors import filters

PHYSICS_TIMESTEP = 0.0025  # s: benchmarks/simulation/physics_step.py, results in suite/README.md


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSettings:
  """Settings of a task."""

  time_limit: float
  """Length of an episode [s]."""
  physics_timestep: float = PHYSICS_TIMESTEP
  """s; the control step is a multiple of it."""
  privileged: bool = True
  """Whether to give the observations that only the critic may see."""
  effects: Sequence[Effect] = ()
  """What the nominal model lacks; targets with or without "op3/"."""
  draw_effects: bool = False
  """Whether every episode draws the effects' values from their intervals."""
  randomisation: RandomisationSettings = dataclasses.field(default_factory=RandomisationSettings)
  """Which parts of an episode are random."""

  def __post_init__(self):
    if not 0 < self.time_limit < math.inf:
      raise ValueError(f"The time_limit must be positive and finite [s], found {self.time_limit}.")
    steps = constants.CONTROL_TIMESTEP / self.physics_timestep if self.physics_timestep > 0 else 0
    if not (steps >= 1 and abs(steps - round(steps)) < 1e-6):
      raise ValueError(
        f"The physics_timestep must divide the control step of {constants.CONTROL_TIMESTEP} s, "
        f"found {self.physics_timestep}."
      )
    longest = 0.5 / filters.CHIP_BANDWIDTH_HZ
    if self.physics_timestep >= longest:
      raise ValueError(
        f"The physics_timestep must be below {longest:.4f} s, so that the IMU chip's low-pass of "
        f"{filters.CHIP_BANDWIDTH_HZ:g} Hz can be simulated, found {self.physics_timestep}."
      )
