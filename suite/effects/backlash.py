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
    self._encoder_on_motor = bool(self._on_motor.any())
    self._free = self._half > 0  # joints that have a gap at all
    self._any_free = bool(self._free.any())
    self._armature = model.dof_armature[dofs].copy()
    self._damping = model.dof_damping[dofs].copy()
    rotor = self._armature * (1 - _LINK_SHARE)
    self._rotor = np.where(rotor > 0, rotor, _ROTOR_WITHOUT_ARMATURE * model.dof_M0[dofs])
    self._link_armature = self._armature - np.minimum(rotor, self._armature)
    self._per_torque = binding.timestep / self._rotor
    # Damping of the motor is implicit, as in the simulator.
    self._keep = 1 / (1 + self._per_torque * self._damping)
    self._driven = np.flatnonzero(binding.actuator_joint >= 0)
    self._joint_of = binding.actuator_joint[self._driven]
    self._gear = binding.gear[self._driven]
    self._simple = np.array_equal(binding.actuator_joint, np.arange(len(binding.joints)))
    self.offset = np.zeros(len(binding.joints))
    """Motor position minus link position, [J] rad, within half the gap."""
    self._speed = np.zeros(len(binding.joints))
    self._last_torque, self._last_velocity = np.zeros((2, len(binding.joints)))
    self._per_step = self._rotor / binding.timestep
    self._binding = binding
    self._started = False
    self._kick: Array | None = None
    self._set_apart(np.zeros(len(binding.joints), bool))

  def _set_apart(self, apart: Array) -> None:
    self.apart = apart
    """Whether motor and link are apart, [J]."""
    self._any_apart = bool(apart.any())
    self._closed = self._free & ~apart
    self._alive = np.ones(self._binding.model.nu)
    self._alive[self._driven] = ~apart[self._joint_of]
    self._moving = apart * self._binding.timestep

  def reset(self) -> None:
    self.offset[:] = 0.0
    self._started, self._kick = False, None
    if self._any_apart:
      self._set_apart(np.zeros_like(self.apart))
      self._write(self._binding)

  def _torque(self, binding: Binding, speed: Array) -> Array:
    """Returns the actuators' torque on each joint's motor [J] at motor speed."""
    position = binding.position
    if self._encoder_on_motor:
      position = position + binding.encoder_shift
    force = binding.actuator_force(position, speed)
    if self._simple:
      force *= self._gear
      return force
    torque = np.zeros(len(binding.joints))
    np.add.at(torque, self._joint_of, force[self._driven] * self._gear)
    return torque

  def step(self, binding: Binding) -> None:
    if not self._any_free:
      return
    velocity, closed, apart = binding.velocity, self._closed, self.apart
    kick, self._kick = self._kick, None
    if self._any_apart:
      # The motors moved on their own since the last call: which have crossed their gap?
      relative = self._speed - velocity
      moved = self.offset + relative * self._moving
      hit = np.abs(moved) >= self._half
      hit &= apart
      self.offset = np.minimum(np.maximum(moved, -self._half), self._half)
      if np.count_nonzero(hit):
        relative *= self._per_step
        self._kick = np.where(hit, relative, 0.0)
        binding.force += self._kick
        apart = apart & ~hit
    if self._encoder_on_motor:
      binding.encoder_shift += self._on_motor * self.offset
    speed = np.where(apart, self._speed, velocity) if self._any_apart else velocity
    torque = self._torque(binding, speed)
    if not self._started:
      self._started = True
      self.offset = np.where(torque >= 0, self._half, -self._half)
      np.copyto(self._last_torque, torque)
      np.copyto(self._last_velocity, velocity)
      return
    # What the motor passed on in the last step to a link that it touches: torque - J a - damping w,
    # all of that step, as light links need a small difference of large torques. Where it would
    # have had to pull, they part.
    passed = velocity - self._last_velocity
    passed *= self._per_step
    passed += self._damping * velocity
    np.subtract(self._last_torque, passed, out=passed)
    if kick is not None:
      passed += kick
    np.copyto(self._last_torque, torque)
    np.copyto(self._last_velocity, velocity)
    passed *= self.offset
    pulls = passed < 0
    pulls &= closed
    if np.count_nonzero(pulls):
      np.copyto(self._speed, velocity, where=pulls)
      apart = apart | pulls
    if apart is not self.apart:
      self._set_apart(apart)
      self._write(binding)
    if self._any_apart:
      torque *= self._per_torque
      torque += self._speed
      torque *= self._keep
      np.copyto(self._speed, torque, where=apart)
      binding.strength *= self._alive

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
