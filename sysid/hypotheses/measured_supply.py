"""What a measured voltage leaves of a supply that sags: electrical evidence comes first."""

import dataclasses

import numpy as np

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

_MISSED = 4.0
"""Times the fall of a voltage that its readings tell, chosen: of a thin cable's, read at a tenth of
the rate of the positions, they tell four tenths."""
_LEAST = 1e-3  # of what was plausible


def bounded(plant: JointPlant, term: Term) -> Term:
  """Returns a supply's fall under load and over time, of which its measured voltage leaves no more.

  Where a log has no voltage, or other actuators load the supply, too, it is as it was. The bound is
  a multiple of a regression of voltage on time and on the load of the declared servo at the
  measured motion: single readings scatter.
  """
  volts = [log.voltage for log in plant.logs if log.voltage is not None]
  if len(volts) < len(plant.logs) or plant.model.nu > 1:
    return term
  volt, time, speed = (
    np.concatenate(rows)
    for rows in (volts, [log.time for log in plant.logs], [log.velocity for log in plant.logs])
  )
  torque, left = _asked_torque(plant), volt / np.quantile(volt, 0.98)
  load = np.abs(torque) * left
  if dict(term.fixed).get("back_emf"):
    taken = plant.declared[INDEX["damping"]] * speed
    load = torque * (torque * left - taken) / plant.declared[INDEX["highest"]]
  rows = np.stack([np.ones(len(time)), -load, -time], -1)
  full, *lost = np.linalg.lstsq(rows, volt, rcond=None)[0]
  high = tuple(
    min(most, max(_MISSED * float(told / full), _LEAST * most))
    for most, told in zip(term.high, lost, strict=True)
  )
  starts = tuple(tuple(map(min, start, high)) for start in term.starts)
  return dataclasses.replace(term, high=high, starts=starts)


def _asked_torque(plant: JointPlant) -> Array:
  """Returns the declared servo's torque at what was commanded and measured, of all logs [N m]."""
  p, asked = plant.declared, []
  for log in plant.logs:
    at = np.searchsorted(log.command_time, log.time, side="right") - 1
    torque = p[INDEX["input"]] * log.command[np.maximum(at, 0)] + p[INDEX["constant"]]
    torque += p[INDEX["position"]] * log.position + p[INDEX["velocity"]] * log.velocity
    asked.append(np.clip(torque, p[INDEX["lowest"]], p[INDEX["highest"]]))
  return np.concatenate(asked)
