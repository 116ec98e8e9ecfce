"""What reference logs show: constants and effects that a machine has without the fault."""

import dataclasses

from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.evidence import Scored
from nerf2real.sysid.settings import SETTINGS, Settings


def known_terms(found: Scored, settings: Settings = SETTINGS) -> tuple[Term, ...]:
  """Returns the terms of a reference's hypothesis with priors about the values found there."""
  result = []
  repeat = dict(settings.repeat)
  for term in found.terms:
    values = tuple(found.fit.values(term).values())
    if term.kind == CONSTANTS:
      sigma = tuple(repeat[n] for n in term.names)
    else:
      sigma = tuple(
        settings.repeat_effect * max(abs(v), 0.3 * s)
        for v, s in zip(values, term.scale, strict=True)
      )
    known = term.kind != CONSTANTS
    result.append(
      dataclasses.replace(term, prior=sigma, centre=values, starts=(values,), known=known)
    )
  return tuple(result)


_MAY_CHANGE = ("damping", "armature", "friction")


def freed_constants(known: Term, settings: Settings = SETTINGS) -> Term:
  """Returns a reference's constants, of which those that no effect stands for may have changed."""
  tolerance = dict(settings.tolerances)
  sigma = tuple(
    tolerance[n] if n in _MAY_CHANGE else s for n, s in zip(known.names, known.prior, strict=True)
  )
  return dataclasses.replace(known, prior=sigma, freed=True)


_SCALE = "gain"


def widened(own: Term) -> Term:
  """Returns declared constants that may be off by as much as their bounds allow.

  All torques larger by one factor make the same motion: the actuator's keeps its tolerance, and the
  others are off beside it.
  """
  reach = tuple(
    s if n == _SCALE else max(abs(a), abs(b))
    for n, s, a, b in zip(own.names, own.prior, own.low, own.high, strict=True)
  )
  return dataclasses.replace(own, prior=reach, freed=True)
