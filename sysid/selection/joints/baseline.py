"""What reference logs show: constants and effects that a machine has without the fault."""

import dataclasses
from collections.abc import Collection, Mapping

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CLOCKS, CONSTANTS
from nerf2real.sysid.hypotheses.plausible import ends
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.settings import SETTINGS, Settings


def known_terms(
  found: Scored, settings: Settings = SETTINGS, *, another_session: bool = False
) -> tuple[Term, ...]:
  """Returns the terms of a reference's hypothesis with priors about the values found there.

  Their means are as open as the reference leaves them: how large all torques of a machine are is
  known by its declared constants alone.
  """
  result: list[Term] = []
  spread = intervals.spread(found.fit, [found.joint])
  for term, (start, stop) in zip(found.terms, found.fit.layout.spans, strict=True):
    values = tuple(found.fit.values(term).values())
    if term.kind == CONSTANTS:
      sigma = tuple(differs(dict(zip(term.names, values, strict=True)), settings, another_session))
    else:
      sigma = tuple(
        settings.repeat_effect * max(abs(v), 0.3 * s)
        for v, s in zip(values, term.scale, strict=True)
      )
    left_open = tuple(map(tuple, spread[start:stop, start:stop].tolist()))
    result.append(
      dataclasses.replace(
        term,
        prior=sigma,
        centre=values,
        open=left_open,
        starts=(values,),
        known=term.kind != CONSTANTS,
      )
    )
  return tuple(result)


def differs(
  constants: Mapping[str, float], settings: Settings, another_session: bool
) -> list[float]:
  """Returns the standard deviations of constants between two recordings of one machine: of shares
  by their own size, of which the declared one is a guess.

  Args:
    constants: values by name.
    settings: the same of declared constants.
    another_session: whether the recordings are of two sessions.
  """
  repeat = dict(settings.repeat)
  if another_session:
    repeat |= dict(settings.another_session)
  return [
    repeat[name] * (1.0 if name in (*CLOCKS, "zero") else 1.0 + value)
    for name, value in constants.items()
  ]


_MAY_CHANGE = ("damping", "armature", "friction")
_ADDED_TO = ("damping", "friction")
"""Constants that effects add to (viscous and dry friction): more of them is such an effect, so that
the constant itself has changed only where it is less."""
_FACTORS = (0.7, 1.4, 1.9, 3.0)  # of a changed constant where searches start, chosen


def freed_constants(known: Term) -> Term:
  """Returns a reference's constants, of which those that no effect stands for may have changed."""
  return _freed(known, _MAY_CHANGE)


def changed_constants(known: Term) -> tuple[Term, ...]:
  """Returns a reference's constants with one of them changed, for each that may have."""
  return tuple(_freed(known, (name,)) for name in known.names if name in _MAY_CHANGE)


def _freed(known: Term, names: Collection[str]) -> Term:
  """Returns constants of which some lie anywhere in their plausible range about what they were."""
  low, high, sigma = list(known.low), list(known.high), list(known.prior)
  starts = [known.starts[0]]
  for at, name in enumerate(known.names):
    if name not in names:
      continue
    before, (least, most) = 1.0 + known.centre[at], ends(kind_of("parameter_error").parameter(name))
    most = 1.0 if name in _ADDED_TO else most
    low[at], high[at], sigma[at] = least * before - 1.0, most * before - 1.0, float("inf")
    starts += [
      tuple(s * before - 1.0 if k == at else v for k, v in enumerate(known.starts[0]))
      for s in _FACTORS
      if s < most
    ]
  return dataclasses.replace(
    known, low=tuple(low), high=tuple(high), prior=tuple(sigma), starts=tuple(starts), freed=True
  )


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
