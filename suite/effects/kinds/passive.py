"""Forces and masses of the joints and bodies that the nominal model lacks."""

import math

import numpy as np

from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Kind, Operator, Parameter
from nerf2real.suite.effects.kinds import laws
from nerf2real.suite.randomisation import inertia

_COGGING = laws.over(laws.cogging)


class ParameterError(Operator):
  """The declared constants are off by factors: no new physics."""

  def bind(self, binding: Binding) -> None:
    model, dofs = binding.model, binding.dofs
    factors = self.per_joint(binding)
    model.dof_damping[dofs] *= factors["damping"]
    model.dof_armature[dofs] *= factors["armature"]
    model.dof_frictionloss[dofs] *= factors["friction"]
    driven = binding.actuator_joint >= 0
    gain = np.where(driven, factors["gain"][np.maximum(binding.actuator_joint, 0)], 1.0)
    model.actuator_gainprm[:, 0] *= gain
    model.actuator_biasprm[:, :3] *= gain[:, None]
    limit = np.where(driven, factors["limit"][np.maximum(binding.actuator_joint, 0)], 1.0)
    model.actuator_forcerange *= limit[:, None]
    for joint, factor in zip(binding.joint_ids, factors["mass"], strict=True):
      if factor != 1:
        body = model.jnt_bodyid[joint]
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
        model.body_gravcomp[body] /= factor  # firmware lifts the declared weight
        binding.masses_changed = True
    if not np.all(factors["armature"] == 1):
      binding.masses_changed = True


class Payload(Operator):
  """A point mass on a body, at a position in the body's frame.

  The target is a body, or a joint, whose body is then meant.
  """

  def bind(self, binding: Binding) -> None:
    for effect in self.effects:
      if effect.target is None:
        raise ValueError("Found a payload without a target, expected the name of a body or joint.")
      if effect.target in binding.joints:
        joint = binding.joint_ids[binding.joints.index(effect.target)]
        body = int(binding.model.jnt_bodyid[joint])
      else:
        body = binding.index("body", effect.target)
      position = np.array([self.value(effect, axis) for axis in "xyz"])
      mass = self.value(effect, "mass")
      inertia.attach_mass(binding.model, body, added=mass, position=position)
      binding.masses_changed |= mass != 0
      binding.loaded[body] |= mass != 0


class Spring(Operator):
  """A spring at the joint: -stiffness * (q - reference), beside the model's own if it has one."""

  def bind(self, binding: Binding) -> None:
    model = binding.model
    parameters = self.per_joint(binding)
    for index, joint in enumerate(binding.joint_ids):
      added, reference = parameters["stiffness"][index], parameters["reference"][index]
      if added == 0:
        continue
      own, address = model.jnt_stiffness[joint], model.jnt_qposadr[joint]
      total = own + added
      model.qpos_spring[address] = (own * model.qpos_spring[address] + added * reference) / total
      model.jnt_stiffness[joint] = total


class Cogging(Operator):
  """A torque that repeats with position (`laws.cogging`)."""

  def bind(self, binding: Binding) -> None:
    parameters = self.per_joint(binding)
    self._law = tuple(parameters[name] for name in ("amplitude", "periods", "phase"))

  def step(self, binding: Binding) -> None:
    binding.force += _COGGING(binding.position, *self._law)


class GravityTilt(Operator):
  """Gravity is not along the model's vertical: turned by (x, y) about the world's axes."""

  def bind(self, binding: Binding) -> None:
    for effect in self.effects:
      turn = matrix_from_rotvec([self.value(effect, "x"), self.value(effect, "y"), 0.0])
      binding.model.opt.gravity[:] = turn @ binding.model.opt.gravity


def _factor(name: str, doc: str, *, high: float = 2.0) -> Parameter:
  return Parameter(name, "1", 1.0, 0.5, high, doc, minimum=0.0)


_OTHER_GEAR = 4.0
"""Times an armature: it grows with the square of the gear's ratio, by 2.8 from 212.6 to 353.5
(XM430-W210 and -W350, Robotis), and its rotor is a guess."""


KINDS = (
  Kind(
    "parameter_error",
    "the declared constants are off",
    "joint",
    "model",
    (
      _factor("damping", "true over declared joint damping"),
      _factor("armature", "true over declared armature", high=_OTHER_GEAR),
      _factor("friction", "true over declared dry friction"),
      _factor("gain", "true over declared actuator gain and bias"),
      _factor("limit", "true over declared limits of the actuator's force"),
      _factor("mass", "true over declared mass and inertia of the joint's body"),
    ),
    ParameterError,
  ),
  Kind(
    "payload",
    "a mass on a body",
    "body",
    "model",
    (
      Parameter("mass", "kg", 0.0, 0.0, 1.0, "point mass", minimum=0.0),
      Parameter("x", "m", 0.0, -0.2, 0.2, "place in the body's frame", shape=True),
      Parameter("y", "m", 0.0, -0.2, 0.2, "place in the body's frame", shape=True),
      Parameter("z", "m", 0.0, -0.2, 0.2, "place in the body's frame", shape=True),
    ),
    Payload,
  ),
  Kind(
    "spring",
    "a spring at the joint",
    "joint",
    "model",
    (
      Parameter("stiffness", "N m/rad", 0.0, 0.0, 5.0, "torque per angle", minimum=0.0),
      Parameter("reference", "rad", 0.0, -1.5, 1.5, "angle without torque", shape=True),
    ),
    Spring,
  ),
  Kind(
    "cogging",
    "a torque that repeats with position",
    "joint",
    "force",
    (
      Parameter("amplitude", "N m", 0.0, 0.0, 0.5, "largest torque"),
      Parameter("periods", "1/rad", 12.0, 2.0, 100.0, "wave number in angle", shape=True),
      Parameter("phase", "1", 0.0, -math.pi, math.pi, "phase at angle 0, radians", shape=True),
    ),
    Cogging,
  ),
  Kind(
    "gravity_tilt",
    "gravity is not along the model's vertical",
    "none",
    "model",
    (
      Parameter("x", "rad", 0.0, -0.2, 0.2, "turn about the world's x axis", of_joint=False),
      Parameter("y", "rad", 0.0, -0.2, 0.2, "turn about the world's y axis", of_joint=False),
    ),
    GravityTilt,
  ),
)
