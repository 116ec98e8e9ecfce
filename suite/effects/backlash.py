"""Backlash of a gear train: a motor and a link that touch only at the ends of a gap.

The declared joint has the motor's reflected inertia (armature) and its damping (back-EMF) attached
rigidly to the link. With backlash the motor is a body of its own inside the gap:

- in contact, the two move as one, as declared;
- when the torque passed on would have to pull, they separate: the link keeps its own inertia and
  dry friction only, and the motor moves by itself, J dw/dt = torque - damping * w;
- when the gap is crossed they collide without bounce, and the momentum J (w - v) passes to the
  link within one step.

Contact is rigid, so no stiffness limits the time step and no degree of freedom is added to the
model. Two hundredths of the armature stay with the link (its output gear), so that a light link
stays regular.

Source: the physical model of Nordin and Gutman 2002, Controlling mechanical systems with backlash,
section 2, with a stiff shaft and inelastic contact.
"""

import numpy as np

from suite.effects.binding import Binding
from suite.effects.effect import Array, Kind, Operator, Parameter

_LINK_SHARE = 0.02  # of the armature, ours
_ROTOR_WITHOUT_ARMATURE = 0.05  # of the joint's inertia, ours, for a model that declares none


class Backlash(Operator):
  """See the module. The joint's position is the link's."""

  def bind(self, binding: Binding) -> None:
    model, dofs = binding.model, binding.dofs
    parameters = self.per_joint(binding)
    self._half = parameters["gap"] / 2
    self._on_motor = parameters["encoder_on_motor"]
    self._free = self._half > 0  # joints that have a gap at all
    self._armature = model.dof_armature[dofs].copy()
    self._damping = model.dof_damping[dofs].copy()
    rotor = self._armature * (1 - _LINK_SHARE)
    self._rotor = np.where(rotor > 0, rotor, _ROTOR_WITHOUT_ARMATURE * model.dof_M0[dofs])
    self._link_armature = self._armature - np.minimum(rotor, self._armature)
    joint = binding.actuator_joint
    self._driven = joint >= 0
    self._joint_of_actuator = np.maximum(joint, 0)
    self.offset = np.zeros(len(binding.joints))
    """Motor position minus link position, [J] rad, within half the gap."""
    self.apart = np.zeros(len(binding.joints), bool)
    """Whether motor and link are apart, [J]."""
    self._speed = np.zeros(len(binding.joints))
    self._binding = binding
    self._started = False

  def reset(self) -> None:
    self.offset[:] = 0.0
    self._started = False
    if self.apart.any():
      self.apart[:] = False
      self._write(self._binding)

  def _torque(self, binding: Binding, speed: Array) -> Array:
    """Returns the actuators' torque on each joint's motor [J] at motor speed."""
    position = binding.position + binding.encoder_shift
    force = binding.actuator_force(position, speed) * binding.gear
    torque = np.zeros(len(binding.joints))
    np.add.at(torque, self._joint_of_actuator[self._driven], force[self._driven])
    return torque

  def step(self, binding: Binding) -> None:
    if not self._free.any():
      return
    step, velocity = binding.timestep, binding.velocity
    changed = False
    if self.apart.any():
      # The motor moved on its own since the last call: has it crossed the gap?
      moved = self.offset + step * (self._speed - velocity)
      hit = self.apart & (np.abs(moved) >= self._half)
      self.offset = np.where(self.apart, np.clip(moved, -self._half, self._half), self.offset)
      if hit.any():
        impulse = self._rotor * (self._speed - velocity)
        binding.force += np.where(hit, impulse / step, 0.0)
        self.apart &= ~hit
        changed = True
    else:
      hit = self.apart
    binding.encoder_shift += self._on_motor * self.offset
    torque = self._torque(binding, np.where(self.apart, self._speed, velocity))
    if not self._started:
      self._started = True
      self.offset = np.where(torque >= 0, self._half, -self._half)
    passed = torque - self._rotor * binding.data.qacc[binding.dofs] - self._damping * velocity
    pulls = self._free & ~self.apart & ~hit & (passed * self.offset < 0)
    if pulls.any():
      self._speed = np.where(pulls, velocity, self._speed)
      self.apart |= pulls
      changed = True
    if self.apart.any():
      # Damping implicit, as in the simulator; the torque's own dependence on speed explicit.
      speed = (self._speed + step / self._rotor * torque) / (1 + step * self._damping / self._rotor)
      self._speed = np.where(self.apart, speed, self._speed)
      apart = self.apart[self._joint_of_actuator] & self._driven
      binding.strength *= np.where(apart, 0.0, 1.0)
    if changed:
      self._write(binding)

  def _write(self, binding: Binding) -> None:
    model, dofs = binding.model, binding.dofs
    model.dof_armature[dofs] = np.where(self.apart, self._link_armature, self._armature)
    model.dof_damping[dofs] = np.where(self.apart, 0.0, self._damping)

  def observe(self, channel: str, value: Array, time: float) -> Array:
    return value + self._on_motor * self.offset if channel == "joint_positions" else value


KINDS = (
  Kind(
    "backlash",
    "play in the gear train",
    "joint",
    "actuator",
    (
      Parameter("gap", "rad", 0.0, 0.0, 0.05, "full width of the play", minimum=0.0),
      Parameter(
        "encoder_on_motor",
        "1",
        0.0,
        0.0,
        1.0,
        "1 if the encoder sits on the motor's side of the gap, 0 on the output (as XM430)",
        minimum=0.0,
        maximum=1.0,
        shape=True,
        fitted=False,
      ),
    ),
    Backlash,
  ),
)
