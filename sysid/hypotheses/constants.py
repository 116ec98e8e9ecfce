"""Nominal constants of a joint with tolerances: what every hypothesis may vary."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from nerf2real.sysid.hypotheses.terms import SERVO_GAIN, STICKING, Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.settings import SETTINGS, Settings

NAME = "calibration"

_GAP = 0.0044
"""rad of play that healthy gears have: 0.25 degrees (data sheet of the XM430-W350)."""

_MESH = 0.02
"""Of the torque that passes it, which a healthy mesh of spur gears loses; chosen: 1 to 2 % are
usual."""

_DRY = ("coulomb_friction", "asymmetric_friction")
"""Kinds that add to the declared dry friction."""


def own_size(
  plant: JointModel, kind: str, name: str, settings: Settings = SETTINGS, *, repeated: bool = False
) -> float:
  """Returns how much of an effect's parameter is no fault: models leave it out of all machines.

  A position servo's own damping is declared no better than a joint's, and no constant is it: its
  gain alone is. Dry friction is declared by no data sheet: where no reference shows it, what is
  added may be what the declared one is off by.

  Args:
    plant: the joint.
    kind: of the effect.
    name: of the parameter.
    settings: tolerances.
    repeated: whether a reference shows the machine.
  """
  if (kind, name) == ("backlash", "gap"):
    return _GAP if plant.hinge else 0.0
  if (kind, name) == ("load_friction", "coefficient"):
    return 0.0 if repeated else _MESH
  if kind in _DRY and not repeated:
    reach = settings.sigmas * dict(settings.tolerances)["friction"]
    return reach * float(plant.declared[INDEX["friction"]])
  if (kind, name) == ("viscous_friction", "coefficient") and plant.holds:
    share = dict(settings.repeat if repeated else settings.tolerances)["damping"]
    return share * max(0.0, -float(plant.declared[INDEX["velocity"]]))
  return 0.0


_USUAL = 2.0
"""Standard deviations within which a machine's own latencies are, 95 %: where no reference shows
them, what is later is a late command or reading, not a constant."""


_SCALES = ("damping", "armature", "gain", "limit", "mass")
_FAR = 0.6  # share that a healthy machine's may be off; chosen
_ROUGH = 4.0  # share by which its dry friction may be more than declared; chosen


def constants(plant: JointModel, settings: Settings = SETTINGS, *, healthy: bool = False) -> Term:
  """Returns the constants of a joint that its model has, with their tolerances as prior.

  Args:
    plant: the joint.
    settings: tolerances.
    healthy: whether its logs are a reference: as late and as strong as they are, the machine is.
  """
  p, tolerance = plant.declared, dict(settings.tolerances)
  if healthy:
    tolerance |= {name: settings.servo for name in ("gain", "limit", "damping")}
  inertia = float(np.mean([s.inertia.mean() for s in plant.surroundings]))
  # A servo's own damping is known no better, and the joint's is off by what that is.
  own = max(0.0, -float(p[INDEX["velocity"]])) / max(float(p[INDEX["damping"]]), 1e-12)
  tolerance["damping"] *= float(np.hypot(1.0, own))
  # A machine lacks the inertia that the model's step adds to its rotor: no fault of the rotor's.
  rotor = max(float(p[INDEX["armature"]]), 1e-12)
  tolerance["armature"] = float(np.hypot(tolerance["armature"], plant.numerical_inertia / rotor))
  present = {
    "damping": p[INDEX["damping"]] > 0,
    "armature": p[INDEX["armature"]] > 0.1 * inertia,
    "friction": p[INDEX["friction"]] > 0,
    "gain": True,
    "limit": healthy and plant.law is None and bool(np.isfinite(p[INDEX["highest"]])),
    "mass": True,
    "zero": plant.holds,
    "skew": True,
    "latency": True,
  }
  names = tuple(n for n, there in present.items() if there)
  sigma = tuple(tolerance[n] for n in names)
  limit = tuple(
    (5.0 if healthy else _USUAL) * s
    if n in ("skew", "latency")
    else (_FAR if healthy and n in _SCALES else min(5.0 * s, 0.9))
    for n, s in zip(names, sigma, strict=True)
  )
  low = tuple(0.0 if n == "latency" else -b for n, b in zip(names, limit, strict=True))
  # What a reference rubs more than declared is the machine's own, however much it is.
  rough = {"friction": _ROUGH} if healthy else {}
  high = tuple(rough.get(n, b) for n, b in zip(names, limit, strict=True))
  zeros = (0.0,) * len(names)
  scale = tuple(
    0.005 if n in ("skew", "latency") else min(s, b / _USUAL)
    for n, s, b in zip(names, sigma, limit, strict=True)
  )
  fixed: tuple[tuple[str, float], ...] = ()
  if plant.law is not None:
    # The duty shows the servo's own law: what is left open is the torque at a duty.
    fixed = (("scales_limit", 1.0),)
    if plant.law[0].is_off(settings.duty_scale):
      fixed = (*fixed, (SERVO_GAIN, plant.law[0].gain))
  return Term(NAME, plant.joint, names, low, high, scale, (zeros,), sigma, zeros, fixed)


def tolerant(own: Term, values: Mapping[str, float]) -> Term:
  """Returns constants of which some may be far off, as the last values show, at a price that grows
  with the distance and not with its square (Huber 1964, by weights).

  All torques larger by one factor make the same motion. So tells a prior alone which of gain,
  masses, damping and armature are off, and a normal one spreads it over all of them: with this one
  most of them stay where they are declared.

  Args:
    own: as `constants` gives them.
    values: of a fit.
  """
  prior = tuple(
    float(np.sqrt(s * max(s, abs(values[n])))) if n in _SCALES else s
    for n, s in zip(own.names, own.prior, strict=True)
  )
  return dataclasses.replace(own, prior=prior)


def sticking(plant: JointModel) -> Term:
  """Returns a dry friction that holds at rest, of which nothing is fitted."""
  return Term(STICKING, plant.joint, (), (), (), (), ((),), known=True)
