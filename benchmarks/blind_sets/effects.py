"""Effects of a machine that its declared model lacks: draws, and what they change in the plant.

`LIBRARY` are the kinds that an analyser may name; `OUTSIDE` are kinds outside its library.
Parameters have the names and units of `suite.effects`; magnitudes are drawn from continuous ranges.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from . import changes, finishing
from .changes import Apply, Parameters
from .machine import Machine


@dataclasses.dataclass(frozen=True)
class Range:
  """Where a parameter is drawn from."""

  low: float
  high: float
  signed: bool = False
  """The sign is drawn too."""
  logarithmic: bool = True

  def draw(self, rng: np.random.Generator) -> float:
    """Returns a value, uniform or uniform in its logarithm."""
    if self.logarithmic:
      value = float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
    else:
      value = float(rng.uniform(self.low, self.high))
    return -value if self.signed and rng.random() < 0.5 else value

  def stronger(self, value: float, factor: float) -> float:
    """Returns the value times the factor, no larger than the range allows."""
    return float(np.copysign(min(abs(value) * factor, self.high), value))


@dataclasses.dataclass(frozen=True)
class Maker:
  """One kind: ranges of its parameters, what to scale for a stronger effect, what it changes."""

  ranges: dict[str, Range]
  strength: tuple[str, ...]
  apply: Apply
  everywhere: bool = False
  """The effect has no joint: it is the whole machine's."""
  plants: tuple[str, ...] = ("pendulum", "arm", "op3")
  finish: Callable[[np.random.Generator, Parameters], Parameters] | None = None
  """Turns what was drawn into what is applied and written down."""


_MULTI = ("arm", "op3")

LIBRARY: dict[str, Maker] = {
  "command_delay": Maker({"delay": Range(0.008, 0.06)}, ("delay",), changes.adds(latency="delay")),
  "measurement_delay": Maker({"delay": Range(0.008, 0.06)}, ("delay",), changes.measurement_delay),
  "clock_drift": Maker(
    {"rate": Range(0.0015, 0.008, signed=True)},
    ("rate",),
    changes.clock_drift,
    True,
    finish=finishing.drift,
  ),
  "coulomb_friction": Maker(
    {"torque": Range(0.06, 0.45)}, ("torque",), changes.adds(coulomb="torque")
  ),
  "viscous_friction": Maker(
    {"coefficient": Range(0.2, 1.2)}, ("coefficient",), changes.adds(viscous="coefficient")
  ),
  "stribeck_friction": Maker(
    {"breakaway": Range(0.08, 0.5), "velocity": Range(0.05, 0.4)}, ("breakaway",), changes.stribeck
  ),
  "load_friction": Maker(
    {"coefficient": Range(0.08, 0.4)},
    ("coefficient",),
    changes.sets(load="coefficient", load_of_motor="of_motor"),
    finish=finishing.load,
  ),
  "asymmetric_friction": Maker(
    {"positive": Range(0.02, 0.08), "negative": Range(0.12, 0.5)},
    ("positive", "negative"),
    changes.adds(positive="positive", negative="negative"),
    finish=finishing.one_sided,
  ),
  "quadratic_drag": Maker(
    {"coefficient": Range(0.06, 0.6)}, ("coefficient",), changes.adds(quadratic="coefficient")
  ),
  "backlash": Maker(
    {"gap": Range(0.006, 0.05)},
    ("gap",),
    changes.adds(gap="gap", encoder_on_motor="encoder_on_motor"),
    finish=finishing.motor_side,
  ),
  "encoder_offset": Maker(
    {"offset": Range(0.012, 0.12, signed=True)}, ("offset",), changes.adds(encoder_offset="offset")
  ),
  "motor_gain": Maker(
    {"change": Range(0.1, 0.4)}, ("gain",), changes.motor_gain, finish=finishing.gain
  ),
  "supply_sag": Maker(
    {"droop": Range(0.01, 0.08), "fade": Range(0.003, 0.012)},
    ("droop", "fade"),
    changes.supply_sag,
    True,
    finish=finishing.sag,
  ),
  "torque_limit": Maker(
    {"lost": Range(0.3, 0.8, logarithmic=False)},
    ("limit",),
    changes.torque_limit,
    finish=finishing.limit,
  ),
  "thermal_derating": Maker(
    {"heating": Range(0.3, 3.0), "time_constant": Range(60, 400), "derating": Range(0.003, 0.01)},
    ("heating",),
    changes.sets(heating="heating", cooling_time="time_constant", derating="derating"),
  ),
  "payload": Maker(
    {"mass": Range(0.04, 0.35), **{f"off_{a}": Range(0.005, 0.05, signed=True) for a in "xyz"}},
    ("mass",),
    changes.payload,
  ),
  "spring": Maker(
    {"stiffness": Range(0.4, 4.0), "reference": Range(0.02, 0.8, signed=True)},
    ("stiffness",),
    changes.sets(spring_stiffness="stiffness", spring_reference="reference"),
  ),
  "cogging": Maker(
    {
      "amplitude": Range(0.08, 0.4),
      "periods": Range(6, 40),
      "phase": Range(-3.1, 3.1, logarithmic=False),
    },
    ("amplitude",),
    changes.sets(cogging_amplitude="amplitude", cogging_periods="periods", cogging_phase="phase"),
  ),
  # On one joint alone tilted gravity equals an offset encoder: not drawn for the pendulum.
  "gravity_tilt": Maker(
    {"x": Range(0.04, 0.2, signed=True), "y": Range(0.04, 0.2, signed=True)},
    ("x", "y"),
    changes.gravity_tilt,
    True,
    _MULTI,
  ),
  "parameter_error": Maker(
    {
      "damping": Range(0.08, 0.2, signed=True),
      "armature": Range(0.08, 0.2, signed=True),
      "friction": Range(0.08, 0.3, signed=True),
    },
    ("damping", "armature", "friction"),
    changes.parameter_error,
    True,
    finish=finishing.off_by,
  ),
}

OUTSIDE: dict[str, Maker] = {
  "sticking_spot": Maker(
    {
      "depth": Range(0.25, 0.9),
      "center": Range(0.02, 0.4, signed=True),
      "width": Range(0.03, 0.12),
    },
    ("depth",),
    changes.sets(stick_depth="depth", stick_center="center", stick_width="width"),
  ),
  "time_varying_stiffness": Maker(
    {
      "stiffness": Range(1.5, 6.0),
      "period": Range(3.0, 9.0),
      "reference": Range(0.05, 0.6, signed=True),
    },
    ("stiffness",),
    changes.sets(
      varying_stiffness="stiffness", varying_period="period", varying_reference="reference"
    ),
  ),
  "flexible_link": Maker(
    {"inertia": Range(0.008, 0.03), "rate": Range(12.0, 30.0), "damping": Range(0.02, 0.1)},
    ("inertia",),
    changes.sets(flexible_inertia="inertia", flexible_rate="rate", flexible_damping="damping"),
  ),
  "torque_dropout": Maker(
    {"every": Range(0.6, 2.0), "lasting": Range(0.06, 0.25)},
    ("lasting",),
    changes.dropout,
    finish=finishing.with_seed,
  ),
  "magnetic_detent": Maker(
    {
      "torque": Range(0.25, 1.0),
      "center": Range(0.02, 0.45, signed=True),
      "width": Range(0.03, 0.1),
    },
    ("torque",),
    changes.sets(detent_torque="torque", detent_center="center", detent_width="width"),
  ),
  "rubber_damper": Maker(
    {"stiffness": Range(1.5, 6.0), "time": Range(0.15, 0.8)},
    ("stiffness",),
    changes.sets(rubber_stiffness="stiffness", rubber_time="time"),
  ),
  "soft_stop": Maker(
    {
      "stiffness": Range(5.0, 25.0),
      "place": Range(0.05, 0.3),
      "center": Range(0.01, 0.1, signed=True),
    },
    ("stiffness",),
    changes.soft_stop,
    finish=finishing.with_side,
  ),
  "growing_friction": Maker(
    {"rate": Range(0.02, 0.06)}, ("rate",), changes.adds(growing_friction="rate")
  ),
  "outside_disturbance": Maker(
    {"torque": Range(0.15, 0.6), "rate": Range(4.0, 25.0)},
    ("torque",),
    changes.sets(disturbance="torque", disturbance_rate="rate"),
  ),
  "weak_in_one_direction": Maker(
    {"share": Range(0.2, 0.5)}, ("share",), changes.sets(weak_side="share")
  ),
  "dead_band": Maker({"counts": Range(12.0, 45.0)}, ("counts",), changes.sets(dead_band="counts")),
}

MAKERS = {**LIBRARY, **OUTSIDE}

# In a pair one of these hides the other, or both are one: two latencies, two dry frictions that
# differ in detail only, three ways to be weak, two static torques, errors of the same constants.
_ALIKE = (
  {"command_delay", "measurement_delay", "clock_drift"},
  {"coulomb_friction", "stribeck_friction", "asymmetric_friction", "load_friction"},
  {"motor_gain", "supply_sag", "torque_limit", "thermal_derating"},
  {"payload", "spring", "encoder_offset", "gravity_tilt"},
  {"parameter_error", "viscous_friction", "quadratic_drag", "coulomb_friction"},
)


def may_pair(first: str, second: str) -> bool:
  """Returns whether two kinds are distinguishable when both are there."""
  return first != second and not any({first, second} <= group for group in _ALIKE)


@dataclasses.dataclass
class Drawn:
  """An effect of one machine."""

  kind: str
  joint: int | None
  parameters: Parameters

  @property
  def maker(self) -> Maker:
    return MAKERS[self.kind]

  def apply(self, machine: Machine) -> None:
    """Puts the effect into a machine."""
    target = slice(None) if self.joint is None else self.joint
    self.maker.apply(machine, target, self.parameters)


def draw_effect(kind: str, rng: np.random.Generator, *, joint: int, center: float) -> Drawn:
  """Draws an effect of a kind.

  Args:
    kind: a name in `MAKERS`.
    rng: draws the parameters.
    joint: the joint it sits at, unless the kind is the whole machine's.
    center: rad, middle of that joint's excitation: places in angle are drawn about it.
  """
  maker = MAKERS[kind]
  parameters = {name: span.draw(rng) for name, span in maker.ranges.items()}
  if kind != "spring":
    for name in ("center", "reference"):
      if name in parameters:
        parameters[name] += center
  if maker.finish is not None:
    parameters = maker.finish(rng, parameters)
  return Drawn(kind, None if maker.everywhere else joint, parameters)


def make_stronger(effect: Drawn, factor: float) -> bool:
  """Scales an effect's strength within its ranges; returns whether anything changed."""
  before = dict(effect.parameters)
  for name in effect.maker.strength:
    value = effect.parameters[name]
    if effect.kind == "motor_gain":
      change = effect.maker.ranges["change"].stronger(value - 1, factor)
      effect.parameters[name] = 1 + change
    elif effect.kind == "torque_limit":
      effect.parameters[name] = max(value / factor, 4.1 * (1 - effect.maker.ranges["lost"].high))
    elif effect.kind == "parameter_error":
      effect.parameters[name] = 1 + effect.maker.ranges[name].stronger(value - 1, factor)
    elif value:
      widest = max(effect.maker.ranges[other].high for other in effect.maker.strength)
      span = dataclasses.replace(effect.maker.ranges[name], high=widest)
      if effect.kind == "supply_sag":
        span = effect.maker.ranges[name]
      effect.parameters[name] = span.stronger(value, factor)
  return effect.parameters != before
