"""Gravity compensation of firmware, which knows the declared machine and what its encoders read.

MuJoCo lifts every body at its centre of mass by `gravcomp` times its weight, whatever the model
says that it weighs. Firmware lifts the weight that it was told: a payload, a tilt or a shifted zero
that it does not know of is not lifted. Where effects bring one, the declared weights are lifted
here instead, at the place of each body that the encoders tell.
"""

import mujoco
import numpy as np

from nerf2real.suite.effects.binding import Array, Binding


class Compensation:
  """The lift of the declared machine's bodies."""

  def __init__(self, binding: Binding):
    """Takes over what MuJoCo lifts.

    Args:
      binding: of all effects, bound; its model lifts nothing from then on, until it is restored.
    """
    model, declared = binding.model, binding.snapshot
    share = declared["body_gravcomp"]
    self._bodies = np.flatnonzero(share)
    self._forces = -(share * declared["body_mass"])[self._bodies, None] * binding.gravity
    self._places = declared["body_ipos"][self._bodies]
    self._offset, self._qpos = binding.encoder_offset, binding.qpos
    self._model, self._read = model, mujoco.MjData(model)
    model.body_gravcomp[:] = 0.0

  def torques(self, data: mujoco.MjData) -> Array:
    """Returns what lifts the machine, as a force on every degree of freedom [nv]."""
    model, read = self._model, self._read
    read.qpos[:] = data.qpos
    read.qpos[self._qpos] += self._offset
    mujoco.mj_kinematics(model, read)
    mujoco.mj_comPos(model, read)
    result, none = np.zeros(model.nv), np.zeros(3)
    for body, force, place in zip(self._bodies, self._forces, self._places, strict=True):
      point = read.xpos[body] + read.xmat[body].reshape(3, 3) @ place
      mujoco.mj_applyFT(model, read, force, none, point, body, result)
    return result


def unknown_to_firmware(binding: Binding) -> Compensation | None:
  """Returns what firmware lifts where effects bring what it does not know, else None."""
  lifted = binding.snapshot["body_gravcomp"] != 0
  turned = np.any(binding.model.opt.gravity != binding.gravity)
  if np.any(lifted & binding.loaded):
    return Compensation(binding)
  if lifted.any() and (turned or np.any(binding.encoder_offset)):
    return Compensation(binding)
  return None
