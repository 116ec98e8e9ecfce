"""Whether a name that is clear stands: its values are something, they are new, and it is needed
beside a force of any form.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CLOCKS
from nerf2real.sysid.hypotheses.constants import own_size
from nerf2real.sysid.hypotheses.free_force import VARIABLE
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.joints.remainder import mean_left
from nerf2real.sysid.selection.joints.subject import Subject
from nerf2real.sysid.selection.search import rivals
from nerf2real.sysid.selection.search.evidence import Scored, clear, more_likely
from nerf2real.sysid.selection.search.explain import Explainer, scored_on
from nerf2real.sysid.settings import Settings

Array = np.ndarray

_CLOCK = {"measurement_delay": "skew", "command_delay": "latency"}
"""Constants that do to positions what a kind does."""
_AT_END = 1e-3  # of a range: a value as near to its end has been stopped there

_SCATTER = ("friction",)  # constants that no drawing or data sheet holds

_MOST = 0.95  # chosen: a law that explains so much of what a force of any form does is its law


def supported(
  explainer: Explainer,
  best: Scored,
  named: Sequence[str],
  beyond: float,
  *,
  anyway: float,
  forced: Sequence[str],
) -> tuple[str, ...]:
  """Returns the names that stand where something is left that no name is for.

  What is named may then be a part of that: half of a soft stop is a spring. A kind must explain
  more squares than remain, both of fits to all logs: left-out blocks are predicted with effects
  that were fitted without them beside constants that were fitted to all, which is for the
  hypothesis that lacks the effect. Where constants could stand in for a kind only by being off by
  more than they are, it is left out with all else as it is beside it. One that is a force over one
  variable stands unless a force of any form over that variable does clearly better and explains a
  twentieth more of the squares; any other where hypotheses with a force of any form over both are
  clearly worse without it, with constants that may be off where they are in the best hypothesis.

  Args:
    explainer: scores what has not been scored.
    best: the best hypothesis, of which more remains than the machine leaves anyway.
    named: kinds that are clear.
    beyond: standard errors that count as clear.
    anyway: mean square that the machine leaves anyway.
    forced: kinds that are tried beside a force.
  """
  kept = []
  left = _left(explainer, best)
  for kind in named:
    without = rivals.lacking(explainer, best, kind)
    strained = without.is_strained(explainer.settings.level)
    explained = (
      _left_bare(explainer, best, kind) if strained else _left(explainer, without)
    ) - left
    if explained <= left - anyway or kind not in forced:
      stands = explained > left - anyway
    elif kind in VARIABLE:
      rival = rivals.with_force(explainer, without, VARIABLE[kind])
      stands = clear(rival, best) <= beyond or (
        explained >= _MOST * (explained + left - _left(explainer, rival))
      )
    else:
      both = [best, without]
      if best.is_strained(explainer.settings.level):  # the constants are off: in either
        both = [rivals.with_freed(explainer, s) for s in both]
      beside, bare = (rivals.with_force(explainer, s) for s in both)
      stands = clear(beside, bare) > beyond
    if stands:
      kept.append(kind)
  return tuple(kept)


def _left(explainer: Explainer, item: Scored) -> float:
  """Returns the mean square that a hypothesis leaves where it is fitted to all logs."""
  joint = explainer.joint
  return mean_left(joint, joint.squares(item.fit.residuals[0])[0])


def _left_bare(explainer: Explainer, item: Scored, kind: str) -> float:
  """Returns the mean square that a hypothesis leaves without one of its effects and with all else
  as it was fitted beside it; freed constants are then those that are known."""
  joint, known = explainer.joint, {t.kind: t for t in explainer.base}
  terms, x = [], []
  for term in item.terms:
    kept = known.get(term.kind) if term.name == kind else term
    if kept is not None:
      terms.append(kept)
      x += list(item.fit.values(term).values() if kept is term else kept.centre)
  return mean_left(joint, joint.squares(joint.residuals(terms, np.array(x)[None])[0])[0])


def is_something(subject: Subject, best: Scored, kind: str) -> bool:
  """Tells whether an effect's sizes differ from those that do nothing, by their intervals.

  What healthy machines have of an effect is nothing, too: what else is off may show it where a
  reference did not. So is what a constant differs by between two recordings. A payload's mass and
  place may be open where a moment of it is sure.
  """
  term = next(t for t in best.terms if t.name == kind)
  if term.freed and subject.before is not None:
    return _has_changed(subject, best, term)
  return term.freed or exceeds(subject, best, term)


def exceeds(subject: Subject, item: Scored, term: Term) -> bool:
  """Tells whether an effect of a hypothesis is more than nothing and than healthy machines have."""
  if not term.names or _moment_shows(subject, item, term):
    return True
  alone = subject.before is None
  sizes = {p.name: p.nominal for p in kind_of(term.kind).parameters if not p.shape}
  bounds = intervals.intervals(subject.now, item.fit, term, own_latency=alone)
  taken = 0.0 if alone else _taken_back(subject, item, term.kind)

  def own(name: str) -> float:
    plant, settings = subject.now.plant, subject.now.settings
    return taken + own_size(plant, term.kind, name, settings, repeated=not alone)

  return any(
    not low - own(name) <= sizes[name] <= high
    for name, (low, high) in bounds.items()
    if name in sizes
  )


def _moment_shows(subject: Subject, item: Scored, term: Term) -> bool:
  """Tells whether a moment of a payload is surely not zero: what gravity takes of it, or what it
  adds to an inertia about an axis of its body."""
  if term.kind != "payload":
    return False
  layout = item.fit.layout
  span = slice(*layout.spans[layout.terms.index(term)])
  covariance = intervals.spread(item.fit, [subject.now])[span, span]
  mass, *place = item.fit.x[span]
  arms = np.array(place)
  away = arms @ arms - arms**2  # from the body's axes, squared
  first = np.column_stack([arms, mass * np.eye(3)])
  second = np.column_stack([away, 2.0 * mass * (1.0 - np.eye(3)) * arms])
  moments, slopes = mass * np.concatenate([arms, away]), np.concatenate([first, second])
  sure = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slopes, covariance, slopes), 0.0))
  return bool(np.any(np.abs(moments) > subject.now.settings.sigmas * sure))


def _taken_back(subject: Subject, item: Scored, kind: str) -> float:
  """Returns the s of a delay that a hypothesis' clock takes back, by being less than it was."""
  if kind not in _CLOCK:
    return 0.0
  before = dict(zip(subject.known[0].names, subject.known[0].centre, strict=True))
  now = item.fit.values(item.terms[0])
  return max(before[_CLOCK[kind]] - now[_CLOCK[kind]], 0.0)


def _has_changed(subject: Subject, best: Scored, term: Term) -> bool:
  """Tells whether a constant that may have changed did, all of its interval, by more than it
  differs by between two recordings of one machine."""
  before = subject.known[0]
  bounds = intervals.intervals(subject.now, best.fit, term, own_latency=False)
  reach = subject.now.settings.sigmas * np.array(before.prior)
  return any(
    bounds[name][0] > value + most or bounds[name][1] < value - most
    for name, value, most, free in zip(
      term.names, before.centre, reach, np.isinf(term.prior), strict=True
    )
    if free
  )


def pressed(best: Scored) -> bool:
  """Tells whether constants that may be off lie at an end of what is plausible: they stand in for
  something that no hypothesis holds, and what else it names may as well."""
  term = best.terms[0]
  if not term.freed:
    return False
  values = np.array(list(best.fit.values(term).values()))
  low, high = np.array(term.low), np.array(term.high)
  near = np.minimum(values - low, high - values) < _AT_END * (high - low)
  changed = np.isinf(term.prior)  # beside a reference; the others are as they were there
  near &= changed if changed.any() else ~np.isin(term.names, (*CLOCKS, "zero"))
  return bool(near.any())


def is_new(subject: Subject, best: Scored, kind: str) -> bool:
  """Tells whether an effect of the logs' best hypothesis is what has changed, by `newness`."""
  term = next(t for t in best.terms if t.name == kind)
  if term.freed:
    return True
  held = term.held_at(np.array(list(best.fit.values(term).values())))
  return more_likely(*newness(subject, best, term, held), subject.now.settings.level)


def newness(subject: Subject, best: Scored, term: Term, held: Term) -> tuple[Array, float]:
  """Returns by how much logs and reference are more likely where the logs alone have an effect of
  these values than where both have it: nats of the blocks of all logs, and what priors cost.

  Declared constants that are far off may do in the reference what undoes the effect; the logs have
  the same constants, but for what recordings of one machine differ by. They may be better there for
  another reason: then the reference without the effect is taken at the same constants, too.

  Args:
    subject: the joint, with a reference.
    best: the logs' hypothesis.
    term: the effect among its terms.
    held: the same with its values.
  """
  before, usual = subject.before, subject.usual
  assert before is not None and usual is not None
  kept = [(t, usual.fit.values(t)) for t in usual.terms if t.kind != term.kind]
  x = np.array([v for _, values in kept for v in values.values()])
  theirs = scored_on(before, (*[t for t, _ in kept], held), x, iterations=3)
  constants = np.array(list(theirs.fit.values(theirs.terms[0]).values()))
  terms = (_about(best.terms[0], constants), *[held if t is term else t for t in best.terms[1:]])
  values = [v for t in terms[1:] if t is not held for v in best.fit.values(t).values()]
  ours = scored_on(subject.now, terms, np.array([*constants, *values]), iterations=3)
  own = np.array(list(ours.fit.values(terms[0]).values()))
  constants = np.where(np.isinf(best.terms[0].prior), constants, own)
  terms = (_about(subject.known[0], constants), *usual.terms[1:])
  values = [v for t in terms[1:] for v in usual.fit.values(t).values()]
  without = scored_on(before, terms, np.array([*constants, *values]), iterations=3)
  alone = max(((usual, best), (without, ours)), key=lambda pair: sum(s.evidence for s in pair))
  gains = np.concatenate([a.nats - b.nats for a, b in zip(alone, (theirs, ours), strict=True)])
  return gains, sum(s.prior for s in alone) - theirs.prior - ours.prior


def _about(constants: Term, values: Array) -> Term:
  """Returns constants that differ from values as recordings of one machine do."""
  centre = tuple(map(float, values))
  return dataclasses.replace(constants, centre=centre, starts=(centre,))


def constants_off(subject: Subject, best: Scored, settings: Settings) -> bool:
  """Tells whether a declared constant is off by more than its tolerance, all of its interval.

  Dry friction scatters from copy to copy by its tolerance, so that some healthy machine is outside:
  it is off where it is clearly more than tolerance and interval make together. Beside a reference
  the constants are those that it shows.
  """
  term = best.terms[0]
  if subject.before is not None or term.freed:
    return False
  tolerance, values = dict(zip(term.names, term.prior, strict=True)), best.fit.values(term)
  bounds = intervals.intervals(subject.now, best.fit, term, own_latency=True)

  def off(name: str) -> bool:
    low, high = bounds[name]
    if name not in _SCATTER:
      return bool(low > tolerance[name] or high < -tolerance[name])
    sure = (high - low) / (2 * settings.sigmas)
    return bool(abs(values[name]) > subject.beyond * np.hypot(tolerance[name], sure))

  return any(off(name) for name in term.names if name not in (*CLOCKS, "zero"))
