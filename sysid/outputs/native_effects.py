"""Effects with a state or a law of their own, written as native MJCF of MuJoCo 3.17.

- A late command is the actuator's `delay`, interpolated (`interp="linear"`): the mean of the two
  neighbouring commands, as `suite.effects` has it. Its buffer begins with commands of zero.
- Stribeck friction is the LuGre law of a `dcmotor` without input, with all of the joint's dry
  friction: Canudas de Wit, Olsson, Astrom and Lischinsky 1995. Same curve in motion; at rest the
  joint sits on a spring, as stiff as the time step allows, where the suite's constraint creeps, or
  as soft as contacts are that bend before they slide (presliding).
- Cogging, and the constant part of a friction that differs by direction, are a `dcmotor`'s cogging.
- Play is a second joint of the same body behind the motor's, limited to the gap; the limit's
  stiffness and damping are the teeth's. The servo reads its own joint, so play whose encoder is on
  the output cannot be held where the actuator feeds positions back: torque on one joint by the
  position of another is no force that an actuator of MuJoCo can give.
- A late reading is a sensor with `delay`.
"""

import math

import mujoco
import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.suite.effects.kinds import backlash
from nerf2real.suite.effects.registry import kind_of

KINDS = (
  *("command_delay", "stribeck_friction", "presliding", "asymmetric_friction", "cogging"),
  *("backlash", "measurement_delay"),
)
"""Kinds that are written here, in this order: play takes what friction is on the joint by then."""

PLAY = "_play"
"""Ending of the name of the joint that holds a play."""
LATE = {
  "_position_late": mujoco.mjtSensor.mjSENS_JOINTPOS,
  "_velocity_late": mujoco.mjtSensor.mjSENS_JOINTVEL,
}
"""Endings of the names of sensors that read late."""
_LINEAR = 1  # interpolation order
_SPARE = 2  # samples of a buffer beyond the delay
_NO_MOTOR = 1e-6  # torque constant of a motor that is only friction: zero is refused
_NO_INPUT = 16  # mjINPUT_NONE, mjtype.h
# Of the bristles' oscillation times the step; chosen: stiff, and well below 2, where it diverges.
# The law's bristle damping is 0: MuJoCo integrates it as if it were inertia, step times damping.
_RATE = 0.6
_COULOMB, _STIFFNESS = 3, 5  # where the law's are in an actuator's biasprm and dynprm
_LEAST = 1e-3  # Coulomb friction over breakaway where a joint has none: the law divides by it
_IMPEDANCE = 0.999  # of stiff constraints, as in `suite.effects.kinds.friction`


def holds(spec: mujoco.MjSpec, effect: Effect) -> bool:
  """Returns whether an effect can be written."""
  if effect.kind not in KINDS:
    return False
  if effect.kind != "backlash":
    return True
  feedback = [a for a in _actuators(spec, effect) if np.any(np.array(a.biasprm)[1:3])]
  read_outside = bool(feedback) and not _value(effect, "encoder_on_motor")
  alone = all(len(joint.parent.joints) == 1 for joint in joints_of(spec, effect))
  return alone and not read_outside and not _value(effect, "friction_on_link")


def joints_of(spec: mujoco.MjSpec, effect: Effect) -> list[mujoco.MjsJoint]:
  """Returns the hinges and slides that an effect names, all of them where it names none.

  Raises:
    ValueError: the model has no such joint.
  """
  if effect.target is None:
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return [joint for joint in spec.joints if joint.type in single]
  names = [a.target for a in spec.actuators if a.name == effect.target]
  joint = spec.joint(effect.target) or (spec.joint(names[0]) if names else None)
  if joint is None:
    raise ValueError(f"Found no joint {effect.target!r} in the model for {effect.kind}.")
  return [joint]


def put(spec: mujoco.MjSpec, effect: Effect) -> None:
  """Writes an effect that `holds`, after the constants of its joints."""
  match effect.kind:
    case "command_delay":
      for actuator in _actuators(spec, effect):
        _delay(actuator, _value(effect, "delay"), spec.option.timestep)
    case "measurement_delay":
      for joint in joints_of(spec, effect):
        for ending, kind in LATE.items():
          sensor = spec.add_sensor(name=joint.name + ending, type=kind, objname=joint.name)
          sensor.objtype = mujoco.mjtObj.mjOBJ_JOINT
          _delay(sensor, _value(effect, "delay"), spec.option.timestep)
    case "stribeck_friction":
      for joint in joints_of(spec, effect):
        _stribeck(spec, joint, _value(effect, "breakaway"), _value(effect, "velocity"))
    case "presliding":
      for joint in joints_of(spec, effect):
        _presliding(spec, joint, _value(effect, "reach"))
    case "asymmetric_friction":
      positive, negative = _value(effect, "positive"), _value(effect, "negative")
      for joint in joints_of(spec, effect):
        joint.frictionloss += (positive + negative) / 2
        joint.solimp_friction[:2] = _IMPEDANCE
        # A wave of no frequency at its crest is a constant.
        _passive(spec, joint, "offset", cogging=[(negative - positive) / 2, 0.0, math.pi / 2])
    case "cogging":
      wave = [_value(effect, name) for name in ("amplitude", "periods", "phase")]
      for joint in joints_of(spec, effect):
        _passive(spec, joint, "cogging", cogging=wave)
    case "backlash" if _value(effect, "gap") > 0:  # MuJoCo takes no range of one point
      for joint in joints_of(spec, effect):
        _play(spec, joint, effect)


def _value(effect: Effect, name: str) -> float:
  nominal = kind_of(effect.kind).parameter(name).nominal
  return float(effect.parameters.get(name, nominal))  # type: ignore[arg-type]


def _actuators(spec: mujoco.MjSpec, effect: Effect) -> list[mujoco.MjsActuator]:
  """Returns the actuators that have an input and are named, or drive the joints."""
  names = {joint.name for joint in joints_of(spec, effect)}
  inputs = [a for a in spec.actuators if a.biastype != mujoco.mjtBias.mjBIAS_DCMOTOR]
  if effect.target is None:
    return inputs
  return [a for a in inputs if a.name == effect.target or a.target in names]


def _delay(element, delay: float, step: float) -> None:
  """Gives an actuator or sensor a buffer that reaches back far enough."""
  element.delay = element.delay + delay
  element.nsample = math.ceil(element.delay / step) + _SPARE
  element.interp = _LINEAR


def _passive(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, what: str, **law: list[float]) -> None:
  """Adds a motor without input to a joint, which has only a friction or cogging."""
  actuator = spec.add_actuator(name=f"{joint.name}_{what}", target=joint.name)
  actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
  motor = {"motorconst": [_NO_MOTOR, _NO_MOTOR], "resistance": 1.0}
  actuator.set_to_dcmotor(**motor, ctrlspec=_NO_INPUT, **law)


def _inertia(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
  """Returns what a joint accelerates in the reference pose."""
  model = spec.compile()
  return float(model.dof_M0[model.joint(joint.name).dofadr[0]])


def _stribeck(
  spec: mujoco.MjSpec, joint: mujoco.MjsJoint, breakaway: float, velocity: float
) -> None:
  coulomb = max(float(joint.frictionloss), _LEAST * breakaway)
  stiffness = _stiffest(spec, joint)
  joint.frictionloss = 0.0
  law = [stiffness, 0.0, coulomb, coulomb + breakaway, velocity]
  _passive(spec, joint, "friction", lugre=law)


def _stiffest(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
  """Returns the stiffness of bristles that the time step allows."""
  return _inertia(spec, joint) * (_RATE / spec.option.timestep) ** 2


def _presliding(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, reach: float) -> None:
  """Makes the bristles of a joint as soft as its contacts, after Stribeck friction."""
  there = spec.actuator(f"{joint.name}_friction")
  coulomb = float(joint.frictionloss if there is None else there.biasprm[_COULOMB])
  if reach <= 0 or coulomb <= 0:
    return
  stiffness = min(_stiffest(spec, joint), coulomb / reach)
  if there is not None:
    there.dynprm[_STIFFNESS] = min(there.dynprm[_STIFFNESS], stiffness)
    return
  joint.frictionloss = 0.0
  _passive(spec, joint, "friction", lugre=[stiffness, 0.0, coulomb, coulomb, 1.0])


def _play(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, effect: Effect) -> None:
  """Puts a joint for the play behind a joint, which becomes the motor's."""
  rotor = float(joint.armature)
  link = _inertia(spec, joint) - rotor
  if rotor <= 0:
    rotor = backlash.ROTOR_WITHOUT_ARMATURE * link
    joint.armature = rotor
  mobility = 1 / rotor + 1 / link
  half = _value(effect, "gap") / 2
  turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE and spec.compiler.degree
  half = math.degrees(half) if turns else half  # a spec keeps the file's unit of angle
  play = joint.parent.add_joint(
    name=joint.name + PLAY, type=joint.type, axis=joint.axis, pos=joint.pos
  )
  play.range, play.limited = [-half, half], mujoco.mjtLimited.mjLIMITED_TRUE
  # Negative: stiffness and damping, of acceleration.
  play.solref_limit = [
    -_value(effect, "stiffness") * mobility,
    -_value(effect, "damping") * mobility,
  ]
  play.solimp_limit[:2] = _IMPEDANCE
  play.armature = play.frictionloss = 0.0
  play.damping, play.stiffness = 0.0 * np.array(play.damping), 0.0 * np.array(play.stiffness)
