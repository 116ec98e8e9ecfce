"""What of a model is its simulation's and no machine's: time step and softness of dry friction.

MuJoCo's dry friction is a constraint that yields: a joint that it holds creeps, and one that turns
about slows down over its time constant.
"""

from typing import NamedTuple

import mujoco
import numpy as np

_HARDEST = 0.999  # impedance of a constraint that holds; 1 is not allowed
_SHORTEST = 2.0  # steps, of a constraint's time constant (MuJoCo, "Solver parameters")


class Numerics(NamedTuple):
  """How a model is simulated."""

  step: float
  """s."""
  prompt: bool = False
  """Whether dry friction holds and stops as soon as the step lets it."""

  def apply(self, model: mujoco.MjModel) -> None:
    """Writes this into a compiled model."""
    model.opt.timestep = self.step
    if self.prompt:
      rubs = model.dof_frictionloss > 0.0
      model.dof_solref[rubs] = _SHORTEST * self.step, 1.0
      model.dof_solimp[rubs, :2] = _HARDEST

  def write(self, spec: mujoco.MjSpec) -> None:
    """Writes this into a model's source."""
    spec.option.timestep = self.step
    for joint in (j for j in spec.joints if self.prompt and np.any(j.frictionloss > 0.0)):
      joint.solref_friction = [_SHORTEST * self.step, 1.0]
      joint.solimp_friction[:2] = _HARDEST
