"""What a measured voltage leaves of a supply that sags: electrical evidence comes first."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.core.robot_logs.series import ScalarSeries
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import Measured
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_SLACK = 2.0
"""Times the fall that the voltage tells, chosen: a servo may draw half of what the declared one
does."""
_LEAST = 1e-3  # of what was plausible
_WORSE = 2.0
"""Times the squares that the best form leaves, from where on another is none, chosen. What is left
is what no form holds more than noise, so that no likelihood tells which of two is nearer."""
_EXACT = 1e-9  # V^2: less is rounding
_SHIFTS = np.arange(-0.02, 0.0501, 0.002)
"""s by which a voltage may show the load late, chosen: commands take a while to be torques, and
voltage and motion are read one after the other."""


def told(plant: JointPlant, terms: Sequence[Term]) -> list[Term]:
  """Returns the forms of a supply's sag that its measured voltage leaves, bounded by it.

  Where a log has no voltage, or other actuators load the supply, too, they are as they were.
  Voltage is regressed on time and on the load of the declared servo at the measured motion, by the
  duty where it is logged, when the voltage was read: single readings scatter, and are fewer than
  others. A form is left whose load the voltage goes with about as well as with the best one's; its
  values are bounded by a multiple of what is told.
  """
  read = [r.log.battery for r in plant.reductions if r.log.battery is not None]
  if len(read) < len(plant.logs) or plant.model.nu > 1 or not terms:
    return list(terms)
  fits = {draw: _regressed(plant, read, draw) for draw in {_draw(term) for term in terms}}
  best = max(min(fit.squares for fit in fits.values()), _EXACT)
  return [
    _bounded(term, fits[_draw(term)]) for term in terms if fits[_draw(term)].squares < _WORSE * best
  ]


class _Regressed(NamedTuple):
  """Voltage on load and time."""

  lost: Array
  """[2] 1/(N m), 1/s: share of the voltage without load."""
  deviation: Array
  """Standard deviations of that."""
  squares: float
  """Mean square that is left [V^2]."""


def _draw(term: Term) -> str:
  """Returns what loads the supply in a form: torque, current at the bridge, or the motor's."""
  choices = dict(term.fixed)
  if not choices.get("back_emf"):
    return "torque"
  return "pulsed" if choices.get("pulsed") else "bridge"


def _regressed(plant: JointPlant, read: Sequence[ScalarSeries], draw: str) -> _Regressed:
  """Returns the regression at the shift of the load that leaves least."""
  volt = np.concatenate([series.value for series in read])
  time = np.concatenate([series.stamp for series in read])
  left = volt / np.quantile(volt, 0.98)
  loads = []
  for shift in _SHIFTS:
    parts = [
      _at(plant, log, series.stamp - shift) for series, log in zip(read, plant.logs, strict=True)
    ]
    torque, taken = np.concatenate(parts, axis=1)
    current = np.sign(torque) * (torque * left - taken)
    share = np.abs(torque) / plant.declared[INDEX["highest"]]
    loads.append(
      {"torque": np.abs(torque) * left, "bridge": share * current, "pulsed": current}[draw]
    )
  fits = [_least_squares(np.stack([np.ones(len(time)), -load, -time], -1), volt) for load in loads]
  return min(fits, key=lambda fit: fit.squares)


def _least_squares(columns: Array, volt: Array) -> _Regressed:
  """Returns the regression; its deviations count neighbouring readings that go together once."""
  (full, *lost), *_ = np.linalg.lstsq(columns, volt, rcond=None)
  rest = volt - columns @ np.array([full, *lost])
  square = float(np.mean(rest**2))
  alike = float(np.clip(np.mean(rest[1:] * rest[:-1]) / max(square, _EXACT), 0.0, 0.99))
  independent = len(volt) * (1.0 - alike) / (1.0 + alike)
  spread = np.sqrt(square / independent * len(volt) * np.diag(np.linalg.pinv(columns.T @ columns)))
  return _Regressed(np.array(lost) / full, spread[1:] / full, square)


def _bounded(term: Term, fit: _Regressed) -> Term:
  most = np.array(term.high)
  reach = _SLACK * (fit.lost + SETTINGS.sigmas * fit.deviation)
  high = np.clip(reach, _LEAST * most, most)
  starts = (np.maximum(fit.lost, 0.0), *map(np.array, term.starts))
  starts = tuple(tuple(map(float, np.minimum(start, high))) for start in starts)
  return dataclasses.replace(term, high=tuple(map(float, high)), starts=starts)


def _at(plant: JointPlant, log: Measured, stamp: Array) -> tuple[Array, Array]:
  """Returns the declared servo's torque at full voltage by the duty, else at what was commanded and
  measured, and what the joint's damping takes, both at stamps [N m]."""
  p = plant.declared
  if plant.logs_duty and log.duty is not None:
    torque = p[INDEX["highest"]] * log.duty
  else:
    at = np.searchsorted(log.command_time, log.time, side="right") - 1
    torque = p[INDEX["input"]] * log.command[np.maximum(at, 0)] + p[INDEX["constant"]]
    torque += p[INDEX["position"]] * log.position + p[INDEX["velocity"]] * log.velocity
    torque = np.clip(torque, p[INDEX["lowest"]], p[INDEX["highest"]])
  taken = p[INDEX["damping"]] * log.velocity
  return np.interp(stamp, log.time, torque), np.interp(stamp, log.time, taken)
