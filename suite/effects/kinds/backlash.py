"""Backlash of a gear train: a motor and a link that touch only at the ends of a gap.

The declared joint has the motor's reflected inertia (armature), its damping (back-EMF) and its dry
friction attached rigidly to the link. With backlash the motor is a mass of its own, and those are
on its side, with what other effects add to the friction: most of it lies in the motor and its gear
(`friction_on_link` is the share that does not). The link feels the teeth (`gear_train`) and what
acts on it alone: gravity, contacts, springs, drag.

The motor is no degree of freedom of the model: it is advanced here, in parts of a step, and the
torque that it passes on in the mean acts on the link. Two hundredths of the armature stay with the
link (its output gear), so that a light link stays regular.
"""

import mujoco
import numpy as np

from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Kind, Operator, Parameter
from nerf2real.suite.effects.kinds import gear_train, laws

_STIFFNESS, _BENT_ON, _PRESLIDING = map(
  laws.over, (laws.contact_stiffness, laws.bent_on, laws.presliding)
)

LINK_SHARE = 0.02  # of the armature, ours
ROTOR_WITHOUT_ARMATURE = 0.05  # of the joint's inertia, ours, for a model that declares none


class Backlash(Operator):
  """See the module. The joint's position is the link's."""

  def bind(self, binding: Binding) -> None:
    model = binding.model
    parameters = self.per_joint(binding)
    self._geared = np.flatnonzero(parameters["gap"] > 0)  # G joints of the binding
    geared = self._geared
    self._half = parameters["gap"][geared] / 2
    self._on_motor = parameters["encoder_on_motor"][geared]
    self._stiffness = parameters["stiffness"][geared]
    self._tooth_damping = parameters["damping"][geared]
    dofs = model.jnt_dofadr[binding.joint_ids[geared]]
    self._dofs = dofs
    self._unit = np.eye(model.nv)[dofs]
    self._answer = np.zeros_like(self._unit)
    armature = model.dof_armature[dofs].copy()
    rotor = armature * (1 - LINK_SHARE)
    self._rotor = np.where(rotor > 0, rotor, ROTOR_WITHOUT_ARMATURE * model.dof_M0[dofs])
    self._damping = model.dof_damping[dofs].copy()
    on_link = parameters["friction_on_link"][geared]
    self._friction_on_link, self._friction_on_motor = on_link, 1 - on_link
    self._friction = model.dof_frictionloss[dofs].copy()
    model.dof_armature[dofs] -= np.minimum(rotor, armature)
    self._mobility_at_first = np.diag(1 / (model.dof_M0[dofs] - np.minimum(rotor, armature)))
    model.dof_damping[dofs] = 0.0
    model.dof_frictionloss[dofs] = on_link * self._friction
    of_joint = {int(joint): i for i, joint in enumerate(geared)}
    driven = [u for u, joint in enumerate(binding.actuator_joint) if int(joint) in of_joint]
    self._driven = np.array(driven, int)
    self._place = np.array([of_joint[int(binding.actuator_joint[u])] for u in driven], int)
    binding.simulated[self._driven] = False
    binding.geared[geared] = True
    self._bends = np.flatnonzero(binding.reach[geared] * self._friction_on_motor)  # of G
    own = self._friction_on_motor * self._friction
    reach = binding.reach[geared][self._bends]
    parts = own[self._bends], self._rotor[self._bends], binding.timestep
    self._contact = _STIFFNESS(reach, *parts) if len(self._bends) else reach
    self._bent, self._was = np.zeros((2, len(geared)))
    self.offset, self._speed, self._passed = np.zeros((3, len(geared)))
    """`offset`: motor position minus link position [G] rad."""
    self._last_velocity = np.zeros(len(geared))
    self._started = False

  def reset(self) -> None:
    self.offset[:] = 0.0
    self._bent[:] = 0.0
    self._started = False

  def step(self, binding: Binding) -> None:
    geared = self._geared
    if not len(geared):
      return
    velocity = binding.velocity[geared]
    if not self._started:
      self._speed[:] = velocity
    speed, position = binding.velocity.copy(), binding.position
    speed[geared] = self._speed
    if self._on_motor.any():
      binding.encoder_shift[geared] += self._on_motor * self.offset
      position = position + binding.encoder_shift
    force, per_speed = binding.actuator_force(position, speed)
    torque, back_emf = np.zeros((2, len(geared)))
    gear = binding.gear[self._driven]
    np.add.at(torque, self._place, force[self._driven] * gear)
    np.add.at(back_emf, self._place, per_speed[self._driven] * gear)
    if self._started:
      # As of the last step: the mass matrix, and what accelerates links beside their gears.
      mujoco.mj_solveM(binding.model, binding.data, self._answer, self._unit)
      mobility = np.ascontiguousarray(self._answer[:, self._dofs])
      others = (velocity - self._last_velocity) / binding.timestep - mobility @ self._passed
    else:
      self._started, mobility = True, self._mobility_at_first
      self.offset[:] = np.where(torque >= 0, self._half, -self._half)
      others = np.zeros(len(geared))
      self._was[:] = binding.position[geared] + self.offset
    self._last_velocity = velocity
    friction = self._friction_on_motor * (self._friction + binding.friction[geared])
    torque -= back_emf * self._speed
    if len(self._bends):
      self._bend(binding, torque, friction)
    gear_train.advance_joints(
      self.offset,
      self._speed,
      velocity,
      others,
      torque,
      self._damping - back_emf,
      friction,
      self._rotor,
      mobility,
      self._half,
      self._stiffness,
      self._tooth_damping,
      binding.timestep,
      self._passed,
    )
    binding.friction[geared] *= self._friction_on_link
    binding.force[geared] += self._passed
    binding.last_force[self._driven] = force[self._driven]
    binding.strength[self._driven] = 0.0

  def _bend(self, binding: Binding, torque: Array, friction: Array) -> None:
    """Takes what contacts that bend hold off the motors' torques [G], and their dry friction."""
    at, stiffness = self._bends, self._contact
    place = binding.position[self._geared][at] + self.offset[at]
    self._bent[at] = _BENT_ON(self._bent[at], place - self._was[at], stiffness, friction[at])
    self._was[at] = place
    speed = self._speed[at]
    torque[at] -= _PRESLIDING(self._bent[at], speed, stiffness, friction[at], binding.timestep)
    friction[at] = 0.0

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel != "joint_positions" or not self._on_motor.any():
      return value
    value = value.copy()
    value[self._geared] += self._on_motor * self.offset
    return value


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
      Parameter(
        "stiffness",
        "N m/rad",
        1000.0,
        300.0,
        3000.0,
        "of the closed gear; a guess for a servo of some newton metres",
        minimum=1.0,
        shape=True,
        fitted=False,
      ),
      Parameter(
        "damping",
        "N m s/rad",
        0.4,
        0.1,
        2.0,
        "of the closed gear: how far teeth bounce",
        minimum=0.0,
        shape=True,
        fitted=False,
      ),
      Parameter(
        "friction_on_link",
        "1",
        0.0,
        0.0,
        1.0,
        "share of the dry friction on the link's side of the gap",
        minimum=0.0,
        maximum=1.0,
        shape=True,
        fitted=False,
      ),
    ),
    Backlash,
  ),
)
