"""Keeps the values of effects within what is physically plausible."""

import dataclasses

import numpy as np

from nerf2real.suite.effects import Parameter, kind_of
from nerf2real.sysid.hypotheses.candidates import strongest
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import JointPlant

_SLACK = 1.25
"""Times the ends of the registry's ranges, which are where a search may start."""
_CYCLIC = ("phase",)
_SERVO = 2.5
"""N m; stall torque of the OP3's MX-28 (Robotis), of whose kind the registry's ranges are."""

_SIZE = 0.25
"""Power of torque with which a machine's lengths grow: weight goes with their cube."""
_TORQUES = ("N m", "kg")  # what a load weighs, too
_PER_TORQUE = {"1/(N m)": 1, "K/(s N^2 m^2)": 2}
"""Units by the power of torque that they are per."""


def ends(parameter: Parameter) -> tuple[float, float]:
  """Returns the least and the largest value that a parameter is looked for at."""
  low = parameter.low / _SLACK if parameter.low > 0 else parameter.low * _SLACK
  return low, parameter.high * _SLACK


def power_of_torque(unit: str) -> int:
  """Returns the power of torque that a parameter of a hinge goes with: all torques larger by one
  factor, and masses, make the same motion where such parameters are larger by that power of it."""
  return 1 if unit.startswith(_TORQUES) else -_PER_TORQUE.get(unit, 0)


def plausible(term: Term, plant: JointPlant) -> Term:
  """Returns a term of a hinge whose bounds lie within the registry's ranges.

  A machine with more torque than such a servo rubs, springs and carries more, and farther away:
  ranges of torques, of masses, of places and of what is torque per something grow with it; one with
  less may be limited to less, and has more of what is something per torque. Of heat only heating
  times derating shows.
  """
  limit = plant.declared[INDEX["highest"]]
  torque = max(strongest(plant), limit if np.isfinite(limit) else 0.0)
  larger, smaller = max(1.0, torque / _SERVO), min(1.0, torque / _SERVO)
  low, high = list(term.low), list(term.high)
  for at, name in enumerate(term.names):
    if name in _CYCLIC or name not in {p.name for p in kind_of(term.kind).parameters}:
      continue
    parameter = kind_of(term.kind).parameter(name)
    lowest, highest = ends(parameter)
    if parameter.unit.startswith(_TORQUES):
      lowest, highest = lowest * smaller, highest * larger
    elif parameter.unit == "m":
      lowest, highest = lowest * larger**_SIZE, highest * larger**_SIZE
    highest /= smaller ** _PER_TORQUE.get(parameter.unit, 0)
    if name == "heating":
      highest *= kind_of(term.kind).parameter("derating").high / dict(term.fixed)["derating"]
    low[at], high[at] = max(low[at], lowest), min(high[at], highest)
    high[at] = max(high[at], low[at])
  starts = dict.fromkeys(tuple(map(float, np.clip(s, low, high))) for s in term.starts)
  return dataclasses.replace(term, low=tuple(low), high=tuple(high), starts=tuple(starts))
