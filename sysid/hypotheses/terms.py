"""A term: one effect (or the calibration of declared constants) as something that can be fitted.

A hypothesis is a sequence of terms. Each maps its own values to changes of the kernel's parameters
and of the joint's surroundings; the names are those of `suite.effects`, so that a fitted term is an
`Effect`.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.model import kernel
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray
I = kernel.INDEX  # noqa: E741


FREE = "residual_force"
"""The kind that is a force of any form: it explains without a name."""

STICKING = "sticking"
"""The kind of a baseline whose dry friction holds a joint at rest, as that of `suite.effects` does;
MuJoCo's own lets it creep."""


WEAK = "motor_gain"
"""The kind that is a joint's strength, or the supply's where all actuators have it."""

COGGING = "cogging"
"""The kind that is a torque which repeats with position."""

SERVO_GAIN = "servo_gain"
"""Fixed parameter of constants: gain of the servo's law over the declared one, by the duty log."""


@dataclasses.dataclass(frozen=True)
class Term:
  """What is fitted of one kind."""

  kind: str
  target: str | None
  names: tuple[str, ...]
  low: tuple[float, ...]
  high: tuple[float, ...]
  scale: tuple[float, ...]
  """Typical sizes: steps of finite differences are a small fraction of them."""
  starts: tuple[tuple[float, ...], ...]
  prior: tuple[float, ...] = ()
  """Standard deviations of a normal prior, infinite for none; empty for none at all."""
  centre: tuple[float, ...] = ()
  """Means of the prior; empty for zeros."""
  fixed: tuple[tuple[str, float], ...] = ()
  """Parameters that are a choice between models and not fitted."""
  known: bool = False
  """Whether reference logs show it, too."""
  freed: bool = False
  """Whether constants may differ from those that reference logs show."""
  choices: float = 1.0
  """How many effects of this kind that predict different motions its starts were chosen from."""
  open: tuple[tuple[float, ...], ...] = ()
  """Covariance of the prior's means, by the fit to reference logs that they are of; empty where
  they are known. A fit holds to them all the same: values that it finds are as open."""

  @property
  def name(self) -> str | None:
    """What is claimed with this term: a kind of effect; None for constants, known effects and a
    force of any form."""
    if self.kind == "calibration":
      return "parameter_error" if self.freed else None
    return None if self.known or self.kind in (FREE, STICKING) else self.kind

  @property
  def wider(self) -> bool:
    """Whether it is an effect of a body or of the machine that has been found: its values are
    held."""
    return not self.names and self.kind != STICKING

  def apply(self, plant: JointPlant, p: Array, x: Array) -> None:
    """Changes the kernel's parameters [P] in place."""
    values = dict(zip(self.names, x, strict=True)) | dict(self.fixed)
    _APPLY.get(self.kind, _nothing)(plant, p, values)

  def held_at(self, x: Array) -> "Term":
    """Returns a term with these values, of which none is fitted."""
    values = tuple(zip(self.names, map(float, x), strict=True))
    return dataclasses.replace(
      self,
      names=(),
      low=(),
      high=(),
      scale=(),
      starts=((),),
      prior=(),
      centre=(),
      open=(),
      choices=1.0,
      fixed=(*self.fixed, *values),
    )

  def at_rest(self, values: Mapping[str, float]) -> "Term":
    """Returns a term that does nothing, of which nothing is fitted.

    Args:
      values: of the parameters that alone do nothing: what shape an effect has.
    """
    sizes = {p.name: p.nominal for p in kind_of(self.kind).parameters if not p.shape}
    held = self.held_at(np.array([sizes.get(n, values[n]) for n in self.names]))
    return dataclasses.replace(held, known=True)

  def effect(self, x: Array, intervals: Mapping[str, tuple[float, float]] | None = None) -> Effect:
    """Returns the fitted effect."""
    values = {n: float(v) for n, v in zip(self.names, x, strict=True)} | dict(self.fixed)
    if self.kind == "calibration":
      factors = {n: 1.0 + values[n] for n in self.names if n not in ("skew", "latency", "zero")}
      bounds = {n: (1.0 + a, 1.0 + b) for n, (a, b) in (intervals or {}).items() if n in factors}
      if "limit" in factors:
        stronger = factors.get("gain", 1.0)
        factors["limit"] *= stronger
        if "limit" in bounds:
          bounds["limit"] = (stronger * bounds["limit"][0], stronger * bounds["limit"][1])
      if "gain" in factors and values.get("scales_limit", 0.0) > 0:
        servo = values.get(SERVO_GAIN, 1.0)
        factors["gain"], factors["limit"] = servo * factors["gain"], factors["gain"]
        if "gain" in bounds:
          low, high = bounds["gain"]
          bounds |= {"gain": (servo * low, servo * high), "limit": (low, high)}
      return Effect("parameter_error", self.target, factors, bounds)
    known = {p.name for p in kind_of(self.kind).parameters}
    values = {n: v for n, v in values.items() if n in known}
    return Effect(self.kind, self.target, values, dict(intervals or {}))

  def unit(self, name: str, *, slide: bool = False) -> str:
    """Returns the unit of a parameter."""
    if self.kind == "calibration":
      return "1"
    units = kind_of(self.kind).parameter(name).units()
    return units[-1] if slide else units[0]


# as in suite.effects.kinds.friction: impedance 0.999 where an effect adds friction
_STIFF = 1e-3 / 0.999


def _stick(plant: JointPlant, p: Array) -> None:
  """Makes a joint with added dry friction stick, as `suite.effects` does."""
  stiff = _STIFF * plant.inverse_weight
  if p[I["softness"]] != stiff:  # once, whatever number of effects adds friction
    p[I["softness"]] = stiff
    p[I["stopping_rate"]] *= plant.impedance / 0.999


def _nothing(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  """Terms that act on the surroundings alone."""


def _calibration(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  p[I["damping"]] *= 1.0 + v.get("damping", 0.0)
  p[I["armature"]] *= 1.0 + v.get("armature", 0.0)
  p[I["friction"]] *= 1.0 + v.get("friction", 0.0)
  names: tuple[str, ...] = ("input", "constant", "position", "velocity")
  if v.get("scales_limit", 0.0) > 0:  # the torque at a duty; else limits stay
    names = (*names, "lowest", "highest", "strength")
  for name in names:
    p[I[name]] *= 1.0 + v.get("gain", 0.0)
  if "limit" in v:  # a stronger motor has a larger limit, too: what is beside that
    for name in ("lowest", "highest"):
      p[I[name]] *= (1.0 + v.get("gain", 0.0)) * (1.0 + v["limit"])
  p[I["gain"]] *= v.get(SERVO_GAIN, 1.0)
  p[I["measurement_delay"]] += v.get("skew", 0.0)
  p[I["effort_delay"]] += v.get("skew", 0.0)
  p[I["command_delay"]] += v.get("latency", 0.0)
  p[I["encoder_offset"]] += v.get("zero", 0.0)


def _adder(*pairs: tuple[str, str]):
  def apply(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
    for name, slot in pairs:
      p[I[slot]] += v[name]

  return apply


def _setter(*pairs: tuple[str, str]):
  def apply(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
    for name, slot in pairs:
      p[I[slot]] = v[name]

  return apply


def _asymmetric(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  _stick(plant, p)
  p[I["friction"]] += 0.5 * (v["positive"] + v["negative"])
  p[I["offset_force"]] += 0.5 * (v["negative"] - v["positive"])


def _spring(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  own, added = p[I["stiffness"]], v["stiffness"]
  total = own + added
  if total > 0:
    p[I["reference"]] = (own * p[I["reference"]] + added * v["reference"]) / total
  p[I["stiffness"]] = total


def _gain(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  scales_limit = v.get("scales_limit", 0.0) > 0
  names: tuple[str, ...] = ("gain", "lowest", "highest", "strength") if scales_limit else ("gain",)
  if v.get("position_alone", 0.0) > 0:  # the servo's own damping stays
    names = ("input", "constant", "position")
  for name in names:
    p[I[name]] *= v["gain"]
  if v.get("scales_damping", 0.0) > 0:  # back-EMF
    p[I["damping"]] *= v["gain"]


def _weakening(name: str, slots: tuple[str, ...], choices: tuple[str, ...]):
  """Returns what sets an actuator's weakening, with its choices between models."""

  def apply(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
    for slot in slots:
      p[I[slot]] = v[slot]
    p[I[f"{name}_tells"]] = v.get("effort_tells", 1.0)
    for choice in ("scales_limit", *choices):
      p[I[f"{name}_{choice}"]] = v.get(choice, 0.0)

  return apply


def _limit(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  p[I["lowest"]] = max(p[I["lowest"]], -v["limit"])
  p[I["highest"]] = min(p[I["highest"]], v["limit"])


def _coulomb(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  _stick(plant, p)
  p[I["friction"]] += v["torque"]


def _stribeck(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  _stick(plant, p)
  p[I["breakaway"]] = v["breakaway"]
  p[I["stribeck_velocity"]] = v["velocity"]


def _load(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  _stick(plant, p)
  p[I["load_coefficient"]] = v["coefficient"]
  p[I["load_kind"]] = v.get("carried", 0.0)
  p[I["load_square"]] = v.get("quadratic", 0.0)
  p[I["load_at_rest"]] = v.get("rest", 0.0)
  p[I["load_velocity"]] = v.get("velocity", kernel.NEUTRAL["load_velocity"])


def _backlash(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  p[I["gap"]] = v["gap"]
  p[I["encoder_on_motor"]] = v["encoder_on_motor"]
  p[I["tooth_stiffness"]] = v.get("stiffness", kernel.NEUTRAL["tooth_stiffness"])
  p[I["tooth_damping"]] = v.get("damping", kernel.NEUTRAL["tooth_damping"])
  p[I["friction_on_link"]] = v.get("friction_on_link", 0.0)


def _late(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  p[I["measurement_delay"]] += v["delay"]
  if v.get("of_all", 0.0) > 0:
    p[I["surroundings_delay"]] += v["delay"]


def _sticking(plant: JointPlant, p: Array, v: dict[str, float]) -> None:
  _stick(plant, p)


_APPLY = {
  STICKING: _sticking,
  "calibration": _calibration,
  "command_delay": _adder(("delay", "command_delay")),
  "measurement_delay": _late,
  "clock_drift": _setter(("rate", "clock_rate")),
  "coulomb_friction": _coulomb,
  "viscous_friction": _adder(("coefficient", "damping")),
  "stribeck_friction": _stribeck,
  "load_friction": _load,
  "asymmetric_friction": _asymmetric,
  "quadratic_drag": _adder(("coefficient", "drag")),
  "presliding": _setter(("reach", "presliding")),
  "backlash": _backlash,
  "encoder_offset": _adder(("offset", "encoder_offset")),
  "motor_gain": _gain,
  "torque_limit": _limit,
  "supply_sag": _weakening("sag", ("droop", "fade"), ("back_emf", "pulsed")),
  "thermal_derating": _weakening("heat", ("heating", "time_constant", "derating"), ("back_emf",)),
  "spring": _spring,
  COGGING: _setter(("amplitude", "amplitude"), ("periods", "periods"), ("phase", "phase")),
}
