"""model_extended.xml: the declared model with what MuJoCo itself can express put in.

Constants are corrected; friction, drag, springs, gains, limits, offsets, payloads and tilts are
written as attributes, a sloping floor is turned; delays, Stribeck friction, contacts that bend,
cogging, friction that differs by direction and play are native elements (`native_effects`). The
file needs MuJoCo 3.7 or later and nothing of this project. What MJCF cannot hold (load friction,
heat, supply, learned forces, sensors' errors) is listed in a comment of the file, and stays in
effects.json.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.files import write_atomically
from nerf2real.suite.effects import Effect
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.outputs import native_effects

_PROMPT = 1e-4  # s, of latencies that need no word
_POINT = 1e-4  # m, radius of a payload: no inertia of its own

EXPRESSED = (
  *("parameter_error", "coulomb_friction", "viscous_friction", "quadratic_drag", "motor_gain"),
  *("torque_limit", "encoder_offset", "payload", "spring", "gravity_tilt"),
  "floor_slope",
)
"""Kinds that are constants of a model."""


def write(
  source: Path,
  target: Path,
  effects: Sequence[Effect],
  *,
  clocks: Mapping[str, Clocks] | None = None,
  numerics: Numerics | None = None,
  on_stand: bool = False,
) -> list[Effect]:
  """Writes the extended model.

  Args:
    source: declared model.
    target: file to write.
    effects: corrections of constants and effects.
    clocks: latencies by joint, which a comment names.
    numerics: of the model that is written; the source's if left out.
    on_stand: whether errors are stated of a free base that is held, which a comment says.

  Returns:
    The effects that MJCF cannot hold.
  """
  spec = mujoco.MjSpec.from_file(str(source))
  if numerics is not None:
    numerics.write(spec)
  _settle_servos(spec)
  # Constants first: friction and play take over what a joint has by then.
  order = [*EXPRESSED, *native_effects.KINDS]
  left, written = [], []
  for effect in sorted(effects, key=lambda e: order.index(e.kind) if e.kind in order else 0):
    if effect.kind == "gravity_tilt" and any(body.gravcomp for body in spec.bodies):
      left.append(effect)  # firmware lifts against the declared gravity, MuJoCo against the turned
      continue
    if effect.kind in EXPRESSED:
      _put(spec, effect)
    elif native_effects.holds(spec, effect):
      native_effects.put(spec, effect)
    else:
      left.append(effect)
      continue
    written.append(effect)
  spec.compile()
  _absolute(spec, source.resolve().parent)
  head, body = spec.to_xml().split("\n", 1)
  write_atomically(target, f"{head}\n{_comment(written, left, clocks or {}, on_stand)}{body}")
  return left


def _settle_servos(spec: mujoco.MjSpec) -> None:
  """Writes the damping of servos that are declared by a ratio as a constant: the machine keeps the
  one it has, whatever its gains and masses are found to be."""
  model = spec.compile()
  for actuator in spec.actuators:
    if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
      actuator.biasprm = model.actuator_biasprm[actuator.id]


def _comment(
  written: Sequence[Effect], left: Sequence[Effect], clocks: Mapping[str, Clocks], on_stand: bool
) -> str:
  """Returns what a reader of the file must know, as an XML comment."""
  lines = [
    f"{len(written)} corrections and effects are in this model; plain MuJoCo simulates them."
  ]
  notes = {
    "command_delay": "Before the first command arrives, actuators act on commands of zero.",
    "measurement_delay": "Positions and velocities are read late by the sensors named *_late.",
    "backlash": "A link is at the sum of its joint and the joint named *_play behind it.",
    "encoder_offset": "Positions read are the joint's plus the offset, which is in the servo only.",
  }
  lines += [note for kind, note in notes.items() if any(e.kind == kind for e in written)]
  if on_stand:
    lines.append("The base is free in this model; errors are stated with it held where it is here.")
  for effect in left:
    values = ", ".join(f"{name} {value}" for name, value in effect.parameters.items())
    lines.append(f"Not in this model: {effect.kind} on {effect.target or 'all'} ({values}).")
  for joint, clock in clocks.items():
    if max(clock.latency, abs(clock.skew)) >= _PROMPT:
      lines.append(
        f"Not in this model: a command of {joint} takes {1e3 * clock.latency:.1f} ms, a reading is "
        f"{1e3 * clock.skew:.1f} ms old; errors are stated with both."
      )
  # A comment may not hold two hyphens in a row.
  text = "\n".join(f"    {line.replace('--', '- -')}" for line in lines)
  return f"  <!--\n{text}\n  -->\n"


def _absolute(spec: mujoco.MjSpec, folder: Path) -> None:
  """Lets a model find its meshes and textures from any folder."""
  if spec.meshes or spec.hfields or spec.skins:
    spec.meshdir = str(folder / spec.meshdir)
  if spec.textures:
    spec.texturedir = str(folder / spec.texturedir)


def _put(spec: mujoco.MjSpec, effect: Effect) -> None:
  value = {n: float(v) for n, v in effect.parameters.items() if isinstance(v, (int, float))}
  if effect.kind == "gravity_tilt":
    turn = Rotation.from_rotvec([value["x"], value["y"], 0.0])
    spec.option.gravity = turn.apply(spec.option.gravity)
    return
  if effect.kind == "floor_slope":
    turn = Rotation.from_rotvec([value["x"], value["y"], 0.0])
    for geom in spec.worldbody.geoms:
      named = geom.name == effect.target
      if named or (effect.target is None and geom.type == mujoco.mjtGeom.mjGEOM_PLANE):
        _turn(spec, geom, turn)
    return
  if effect.kind == "payload":
    body = spec.body(effect.target) or native_effects.joints_of(spec, effect)[0].parent
    carrier = body.add_body(name=f"payload_on_{body.name}", pos=[value[a] for a in "xyz"])
    carrier.add_geom(
      type=mujoco.mjtGeom.mjGEOM_SPHERE,
      size=[_POINT, 0, 0],
      mass=value["mass"],
      contype=0,
      conaffinity=0,
    )
    return
  for joint in native_effects.joints_of(spec, effect):
    _on_joint(spec, effect, joint, value)


def _turn(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, turn: Rotation) -> None:
  """Turns a geom of the world about its origin, however its orientation is written."""
  model = spec.compile()
  before = Rotation.from_quat(model.geom_quat[geom.id], scalar_first=True)
  geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
  geom.quat = (turn * before).as_quat(scalar_first=True)


def _on_joint(spec: mujoco.MjSpec, effect: Effect, joint, value: dict[str, float]) -> None:
  actuators = [a for a in spec.actuators if a.target == joint.name]
  match effect.kind:
    case "parameter_error":
      joint.damping = np.array(joint.damping) * value.get("damping", 1.0)
      joint.armature *= value.get("armature", 1.0)
      joint.frictionloss *= value.get("friction", 1.0)
      for actuator in actuators:
        _scale(actuator, value.get("gain", 1.0))
        actuator.forcerange = np.array(actuator.forcerange) * value.get("limit", 1.0)
      if value.get("mass", 1.0) != 1.0:
        joint.parent.mass *= value["mass"]
        joint.parent.gravcomp /= value["mass"]  # firmware lifts the declared weight
        joint.parent.inertia = np.array(joint.parent.inertia) * value["mass"]
        joint.parent.fullinertia = np.array(joint.parent.fullinertia) * value["mass"]  # NaN: none
        for geom in joint.parent.geoms:
          geom.mass *= value["mass"]
          geom.density *= value["mass"]
    case "coulomb_friction":
      joint.frictionloss += value["torque"]
      joint.solimp_friction[:2] = 0.999
    case "viscous_friction":
      joint.damping = _first_plus(joint.damping, value["coefficient"], 0)
    case "quadratic_drag":
      joint.damping = _first_plus(joint.damping, value["coefficient"], 1)
    case "motor_gain":
      for actuator in actuators:
        damping = actuator.biasprm[2]
        _scale(actuator, value["gain"])
        if value.get("position_alone"):
          actuator.biasprm[2] = damping
        if value.get("scales_limit"):
          actuator.forcerange = np.array(actuator.forcerange) * value["gain"]
      if value.get("scales_damping"):
        joint.damping = np.array(joint.damping) * value["gain"]
    case "torque_limit":
      for actuator in actuators:
        limit = value["limit"] / max(abs(actuator.gear[0]), 1e-9)
        low, high = actuator.forcerange
        if low >= high:  # unlimited so far
          low, high = -limit, limit
        actuator.forcerange = [max(low, -limit), min(high, limit)]
        actuator.forcelimited = True
    case "encoder_offset":
      for actuator in actuators:
        bias = np.array(actuator.biasprm)
        bias[0] += bias[1] * actuator.gear[0] * value["offset"]
        actuator.biasprm = bias
    case "spring":
      own = float(np.ravel(joint.stiffness)[0])
      total = own + value["stiffness"]
      if total > 0:
        turned = joint.type == mujoco.mjtJoint.mjJNT_HINGE and spec.compiler.degree
        unit = np.degrees(1.0) if turned else 1.0  # a spec keeps the file's unit of angle
        added = value["stiffness"] * value["reference"] * unit
        joint.springref = (own * joint.springref + added) / total
      joint.stiffness = _first_plus(joint.stiffness, value["stiffness"], 0)


def _scale(actuator, factor: float) -> None:
  """Multiplies gain and affine bias."""
  gain, bias = np.array(actuator.gainprm), np.array(actuator.biasprm)
  gain[0] *= factor
  bias[:3] *= factor
  actuator.gainprm, actuator.biasprm = gain, bias


def _first_plus(values, added: float, index: int):
  """Returns a coefficient, or polynomial of coefficients, with one raised."""
  array = np.atleast_1d(np.array(values, float)).copy()
  if len(array) == 1:
    return float(array[0] + added)
  array[index] += added
  return array
