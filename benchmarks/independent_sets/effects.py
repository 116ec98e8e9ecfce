"""Effects of a machine that its declared model lacks: drawn, applied, written down."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.independent_sets.apparatus import Apparatus
from benchmarks.independent_sets.machine import Machine

Values = dict[str, float]
_ALL = ("slider", "arm", "wheel")


@dataclasses.dataclass(frozen=True)
class Drawn:
  """An effect on a machine."""

  kind: str
  joint: int | None
  """None: all, or none."""
  values: Values


@dataclasses.dataclass(frozen=True)
class Maker:
  """How effects of a kind are drawn and what they change."""

  draw: Callable[[np.random.Generator, Apparatus, int], Values]
  apply: Callable[[Machine, int, Values, Apparatus], Machine]
  plants: tuple[str, ...] = _ALL
  shared: bool = False
  """It is of the whole machine."""
  group: str = ""
  """Two of a group never pair: they would hide one another."""


def _at(machine: Machine, joint: int, **values: float | Callable[[float], float]) -> Machine:
  """Returns a machine with other constants at a joint."""
  changed = {}
  for name, value in values.items():
    array = getattr(machine, name).copy()
    array[joint] = value(array[joint]) if callable(value) else value
    changed[name] = array
  return machine.change(**changed)


def _friction(machine: Machine, joint: int, added: float) -> Machine:
  """Returns a machine with more Coulomb friction; presliding is as stiff as before."""
  share = 1 + added / machine.coulomb[joint]
  return _at(machine, joint, coulomb=lambda f: f + added, presliding=lambda z: z * share)


def _scale(a: Apparatus, joint: int) -> float:
  """Returns the declared largest torque or force of a joint."""
  m = a.nominal
  if a.mode == "servo":
    return float(m.torque_constant[joint] * m.volts[0] / m.resistance[joint])
  return float(m.torque_constant[joint] * m.current_limit[joint])


def _damping(a: Apparatus, joint: int) -> float:
  """Returns what opposes speed on paper: viscous friction, back-EMF, the velocity loop."""
  m = a.nominal
  if a.mode == "servo":
    return float(m.viscous[joint] + m.torque_constant[joint] ** 2 / m.resistance[joint])
  return float(m.viscous[joint] + (m.velocity_gain[joint] if a.mode == "cascade" else 0.0))


def _delay(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  # A loop that the host closes bears less.
  return {
    "delay": float(rng.uniform(0.006, 0.018) if a.mode == "current" else rng.uniform(0.008, 0.03))
  }


def _viscous(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  share = rng.uniform(1.5, 4.0) if a.mode == "current" else rng.uniform(0.12, 0.45)
  return {"coefficient": float(share * _damping(a, joint))}


def _coulomb(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"torque": float(rng.uniform(1.2, 4.0) * a.nominal.coulomb[joint])}


def _stribeck(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  quick = a.speed * rng.uniform(0.1, 0.4)
  return {"breakaway": float(rng.uniform(1.2, 4.0) * a.nominal.coulomb[joint]), "velocity": quick}


def _payload(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  m, share = a.nominal, float(rng.uniform(0.15, 0.5))
  mass = share * float(m.mass[joint])
  if a.plant == "slider":
    return {"mass": 1.5 * mass, "x": 0.0, "y": 0.0, "z": 0.0}
  reach = abs(float(m.moment_z[joint] / m.mass[joint])) * rng.uniform(0.9, 1.6)
  side = 0.0 if a.plant == "arm" else float(m.moment_x[joint] / m.mass[joint])
  return {"mass": mass, "x": side, "y": 0.0, "z": -float(reach)}


def _load(m: Machine, joint: int, v: Values, a: Apparatus) -> Machine:
  added, x, z = v["mass"], v["x"], v["z"]
  return _at(
    m,
    joint,
    mass=lambda value: value + added,
    inertia=lambda value: value + added * (x * x + z * z),
    moment_x=lambda value: value + added * x,
    moment_z=lambda value: value + added * z,
  )


def _limit(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  share = rng.uniform(0.3, 0.45) if a.mode == "current" else rng.uniform(0.3, 0.6)
  return {"limit": float(share * _scale(a, joint))}


def _limited(m: Machine, joint: int, v: Values, a: Apparatus) -> Machine:
  if a.mode == "servo":  # the register that limits duty
    full = m.torque_constant[joint] * m.volts[0] / m.resistance[joint]
    return _at(m, joint, duty_limit=v["limit"] / full)
  return _at(m, joint, current_limit=v["limit"] / m.torque_constant[joint])


def _gain(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"gain": float(rng.choice([rng.uniform(0.6, 0.85), rng.uniform(1.15, 1.35)]))}


def _weak(m: Machine, joint: int, v: Values, a: Apparatus) -> Machine:
  """Another gain in the firmware of a servo, another torque constant than the drive was given."""
  name = "servo_gain" if a.mode == "servo" else "torque_constant"
  return _at(m, joint, **{name: lambda value: value * v["gain"]})


def _sag(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"droop": float(rng.uniform(0.25, 0.5) / _scale(a, joint)), "fade": rng.uniform(0, 0.01)}


def _sagging(m: Machine, joint: int, v: Values, a: Apparatus) -> Machine:
  ohms = v["droop"] * m.volts[0] * m.torque_constant[joint]
  return _at(m, joint, supply_resistance=ohms).change(fade=np.array([v["fade"]]))


def _armature(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"armature": float(rng.uniform(1.4, 2.2))}


def _gap(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"gap": float(rng.uniform(0.01, 0.04) * a.amplitude[joint])}


def _offset(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"offset": float(rng.choice([-1, 1]) * rng.uniform(0.03, 0.12))}


def _tilt(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {"x": 0.0, "y": float(rng.choice([-1, 1]) * rng.uniform(0.05, 0.15))}


def _one_sided(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  place = a.center[joint] + a.amplitude[joint] * rng.uniform(-0.2, 0.3)
  top = rng.uniform(0.12, 0.3) * _scale(a, joint)
  return {"stiffness": float(top / a.amplitude[joint]), "begins": float(place)}


def _dwell(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {
    "growth": float(rng.uniform(2.0, 6.0) * a.nominal.coulomb[joint]),
    "time": float(rng.uniform(0.1, 0.6)),
  }


def _patch(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  return {
    "depth": float(rng.uniform(2.5, 6.0)),
    "place": float(a.center[joint] + a.amplitude[joint] * rng.uniform(-0.5, 0.5)),
    "width": float(a.amplitude[joint] * rng.uniform(0.06, 0.15)),
  }


def _drift(rng: np.random.Generator, a: Apparatus, joint: int) -> Values:
  size = rng.uniform(0.04, 0.1) * a.amplitude[joint] * rng.choice([-1, 1])
  return {"drift": float(size), "time": float(rng.uniform(3.0, 8.0))}


LIBRARY: dict[str, Maker] = {
  "command_delay": Maker(
    _delay,
    lambda m, j, v, a: m.change(command_delay=m.command_delay + v["delay"]),
    shared=True,
    group="late",
  ),
  "measurement_delay": Maker(
    _delay,
    lambda m, j, v, a: m.change(measurement_delay=m.measurement_delay + v["delay"]),
    shared=True,
    group="late",
  ),
  "viscous_friction": Maker(
    _viscous, lambda m, j, v, a: _at(m, j, viscous=lambda b: b + v["coefficient"]), group="friction"
  ),
  "coulomb_friction": Maker(
    _coulomb, lambda m, j, v, a: _friction(m, j, v["torque"]), group="friction"
  ),
  "stribeck_friction": Maker(
    _stribeck,
    lambda m, j, v, a: _at(m, j, stribeck=v["breakaway"], stribeck_speed=v["velocity"]),
    group="friction",
  ),
  "payload": Maker(_payload, _load, group="inertia"),
  "backlash": Maker(_gap, lambda m, j, v, a: _at(m, j, half_gap=v["gap"] / 2)),
  "torque_limit": Maker(_limit, _limited, group="strength"),
  "motor_gain": Maker(_gain, _weak, group="strength"),
  "supply_sag": Maker(_sag, _sagging, plants=("wheel",), shared=True, group="strength"),
  "parameter_error": Maker(
    _armature,
    lambda m, j, v, a: _at(m, j, rotor=a.nominal.rotor[j] * v["armature"]),
    group="inertia",
  ),
  "encoder_offset": Maker(
    _offset, lambda m, j, v, a: _at(m, j, zero=v["offset"]), plants=("arm", "wheel"), group="zero"
  ),
  "gravity_tilt": Maker(
    _tilt,
    lambda m, j, v, a: m.change(tilt=m.tilt + v["y"]),
    plants=("slider",),
    shared=True,
    group="zero",
  ),
}
OUTSIDE: dict[str, Maker] = {
  "dwell_friction": Maker(
    _dwell,
    lambda m, j, v, a: _at(m, j, dwell_friction=v["growth"], dwell_time=v["time"]),
  ),
  "friction_patch": Maker(
    _patch,
    lambda m, j, v, a: _at(
      m, j, patch_depth=v["depth"], patch_place=v["place"], patch_width=v["width"]
    ),
  ),
  "zero_drift": Maker(
    _drift,
    lambda m, j, v, a: _at(m, j, zero_drift=v["drift"], drift_time=v["time"]),
    plants=("arm",),
  ),
  "one_sided_spring": Maker(
    _one_sided, lambda m, j, v, a: _at(m, j, spring=v["stiffness"], spring_begins=v["begins"])
  ),
}
_MAKERS = LIBRARY | OUTSIDE


def draw(kind: str, rng: np.random.Generator, apparatus: Apparatus, joint: int) -> Drawn:
  """Returns an effect of a kind, drawn."""
  maker = _MAKERS[kind]
  values = maker.draw(rng, apparatus, joint)
  return Drawn(kind, None if maker.shared else joint, values)


def apply(machine: Machine, effect: Drawn, apparatus: Apparatus) -> Machine:
  """Returns a machine with an effect."""
  return _MAKERS[effect.kind].apply(machine, effect.joint or 0, effect.values, apparatus)


def may_pair(first: str, second: str) -> bool:
  """Returns whether two kinds may be in one machine."""
  one, two = _MAKERS[first].group, _MAKERS[second].group
  return first != second and (not one or one != two)


def describe(effect: Drawn, apparatus: Apparatus) -> dict[str, Any]:
  """Returns an effect as answers.json has it."""
  alone = len(apparatus.joints) == 1 and effect.kind not in ("supply_sag", "gravity_tilt")
  index = 0 if effect.joint is None and alone else effect.joint
  joint = None if index is None else apparatus.joints[index]
  entry: dict[str, Any] = {"kind": effect.kind, "joint": joint}
  values = dict(effect.values)
  if effect.kind == "payload":
    assert effect.joint is not None
    entry["body"] = apparatus.bodies[effect.joint]
    entry["pos"] = [values.pop(axis) for axis in "xyz"]
  entry |= values
  if effect.kind in OUTSIDE:
    entry["in_library"] = False
  return entry
