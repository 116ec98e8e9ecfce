"""Keeps the values of effects within what is physically plausible."""

import dataclasses

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.hypotheses.terms import Term

_SLACK = 1.25
"""Times the ends of the registry's ranges, which are where a search may start."""
_CYCLIC = ("phase",)


def plausible(term: Term) -> Term:
  """Returns a term of a hinge whose bounds lie within the registry's ranges."""
  low, high = list(term.low), list(term.high)
  for at, name in enumerate(term.names):
    if name in _CYCLIC or name not in {p.name for p in kind_of(term.kind).parameters}:
      continue
    parameter = kind_of(term.kind).parameter(name)
    lowest = parameter.low / _SLACK if parameter.low > 0 else parameter.low * _SLACK
    low[at], high[at] = max(low[at], lowest), min(high[at], parameter.high * _SLACK)
    high[at] = max(high[at], low[at])
  starts = dict.fromkeys(tuple(map(float, np.clip(s, low, high))) for s in term.starts)
  return dataclasses.replace(term, low=tuple(low), high=tuple(high), starts=tuple(starts))
