"""What a measured voltage leaves of a supply that sags: electrical evidence comes first."""

import dataclasses

import numpy as np

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import Measured
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

_SLACK = 2.0
"""Times the fall that the voltage tells, chosen: a servo may draw half of what the declared one
does."""
_LEAST = 1e-3  # of what was plausible


def bounded(plant: JointPlant, term: Term) -> Term:
  """Returns a supply's fall under load and over time, of which its measured voltage leaves no more.

  Where a log has no voltage, or other actuators load the supply, too, it is as it was. The bound is
  a multiple of a regression of voltage on time and on the load of the declared servo at the
  measured motion, when the voltage was read: single readings scatter, and are fewer than others.
  """
  read = [r.log.battery for r in plant.reductions if r.log.battery is not None]
  if len(read) < len(plant.logs) or plant.model.nu > 1:
    return term
  rows = [
    np.stack([series.value, series.stamp, *_at(plant, log, series.stamp)])
    for series, log in zip(read, plant.logs, strict=True)
  ]
  volt, time, torque, taken = np.concatenate(rows, axis=1)
  left = volt / np.quantile(volt, 0.98)
  load = np.abs(torque) * left
  if dict(term.fixed).get("back_emf"):
    load = torque * (torque * left - taken) / plant.declared[INDEX["highest"]]
  columns = np.stack([np.ones(len(time)), -load, -time], -1)
  full, *lost = np.linalg.lstsq(columns, volt, rcond=None)[0]
  high = tuple(
    min(most, max(_SLACK * float(told / full), _LEAST * most))
    for most, told in zip(term.high, lost, strict=True)
  )
  starts = tuple(tuple(map(min, start, high)) for start in term.starts)
  return dataclasses.replace(term, high=high, starts=starts)


def _at(plant: JointPlant, log: Measured, stamp: Array) -> tuple[Array, Array]:
  """Returns the declared servo's torque at what was commanded and measured, and what the joint's
  damping takes, both at stamps [N m]."""
  p = plant.declared
  at = np.searchsorted(log.command_time, log.time, side="right") - 1
  torque = p[INDEX["input"]] * log.command[np.maximum(at, 0)] + p[INDEX["constant"]]
  torque += p[INDEX["position"]] * log.position + p[INDEX["velocity"]] * log.velocity
  torque = np.clip(torque, p[INDEX["lowest"]], p[INDEX["highest"]])
  taken = p[INDEX["damping"]] * log.velocity
  return np.interp(stamp, log.time, torque), np.interp(stamp, log.time, taken)
