"""Effects of a body or of the whole machine: one hypothesis, evidence summed over its joints.

They come before joints are explained one by one. An effect is of the wider scope where it is
clearly better than nothing, than the same effect at one joint alone and than every other of wider
scope, unless that is clearly better with it beside, and where the joints' explanations need it in
the end.
"""

import dataclasses
import itertools
from collections.abc import Collection, Sequence

import mujoco
import numpy as np
from scipy.stats import norm

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.constancy import is_constant
from nerf2real.sysid.hypotheses.terms import WEAK, Term
from nerf2real.sysid.selection.joints.changes import Changed, may_leave
from nerf2real.sysid.selection.joints.doubts import newness
from nerf2real.sysid.selection.joints.naming import USUAL
from nerf2real.sysid.selection.joints.subject import Subject
from nerf2real.sysid.selection.search import rivals
from nerf2real.sysid.selection.search.evidence import more_likely
from nerf2real.sysid.selection.search.explain import scored_on
from nerf2real.sysid.selection.wider import wide
from nerf2real.sysid.selection.wider.wide import Evidence, Row, Wide
from nerf2real.sysid.settings import Settings

Array = np.ndarray

OPEN = frozenset(("command_delay", "measurement_delay", "payload"))
"""Kinds that a joint may have to itself, or share."""


@dataclasses.dataclass(frozen=True)
class Shared:
  """An effect that several joints share."""

  term: Term
  x: Array
  """Values [n]."""
  reach: tuple[Array, Array]
  """How far they may be below and above [n]."""
  origin: Subject
  """The joint that shows it most."""
  members: tuple[Subject, ...]
  clear: float
  """Standard errors by which it is better than any that lacks it."""
  nats: float
  """What its joints gain together, priors included."""
  or_alone: tuple[float, Array] | None = None
  """Where the same at `origin` alone, whose own it may be, is not clearly worse: standard errors
  that it is behind, and its values there [n]."""
  alike: tuple[tuple[Term, Array], ...] = ()
  """Other effects of wider scope that predict the same motion, and their values [n]."""

  @property
  def key(self) -> tuple[str, str | None]:
    """What it claims: its kind and its body."""
    return self.term.kind, self.term.target

  @property
  def joints(self) -> list[str]:
    """Names of the joints that it concerns: how one is judged may have changed since."""
    return [m.joint for m in self.members]

  @property
  def held(self) -> Term:
    """The effect with its values, of which none is fitted."""
    return dataclasses.replace(self.term.held_at(self.x), known=True)


def shared_effects(
  model: mujoco.MjModel,
  subjects: Sequence[Subject],
  settings: Settings,
  *,
  refuted: Collection[str] = (),
  certain: Collection[str] = (),
) -> list[Shared]:
  """Finds effects of bodies and of the machine, puts them into their joints' hypotheses.

  Args:
    model: the declared one.
    subjects: its joints.
    settings: effort.
    refuted: kinds that are not tried.
    certain: kinds that a joint's own explanation names: their scope may stay open.
  """
  found: list[Shared] = []
  while len(found) < settings.depth:
    before = [s.state for s in subjects]
    known = {s.term.kind for s in found} | set(refuted)
    best = _next(model, subjects, settings, known, certain)
    if best is None:
      for subject, state in zip(subjects, before, strict=True):
        subject.state = state
      break
    found.append(best)
    for member in best.members:
      member.take(best.held)
  return _settled(found)


def found_beside(
  model: mujoco.MjModel,
  changed: Sequence[Changed],
  settings: Settings,
  *,
  known: Collection[str],
  instead: str | None = None,
) -> Shared | None:
  """Returns one more effect of wider scope, beside what joints have of their own, if there is one.

  What a joint has of its own may hide an effect of the machine that was looked for before.

  Args:
    model: the declared one.
    changed: the joints' explanations; they stay.
    settings: effort.
    known: kinds that are not tried.
    instead: a kind that joints have of their own, to be shared in place of that; None for any.
  """
  if not any(c.named for c in changed):
    return None
  subjects = [c.subject for c in changed]
  before = [s.state for s in subjects]
  for item in changed:
    explainer, certain = item.subject.explainer, item.found.best
    for kind in sorted(certain.names - (set(item.named) - {instead})):
      certain = rivals.lacking(explainer, certain, kind)
    explainer.null = certain
  certain_kinds = () if instead is None else (instead,)
  best = _next(model, subjects, settings, known, certain_kinds, only=certain_kinds)
  for subject, state in zip(subjects, before, strict=True):
    subject.state = state
  return best


def _next(
  model: mujoco.MjModel,
  subjects: Sequence[Subject],
  settings: Settings,
  known: Collection[str],
  certain: Collection[str] = (),
  *,
  only: Collection[str] = (),
) -> Shared | None:
  """Returns the best effect of a body or of the machine, if it is clear; joints' scales may have
  changed after. Only some kinds, if given.

  An effect of the machine may be clear of all joints together though none leaves more than it does
  anyway: then by what they leave, not by how likely it is that all constants are off alike. One of
  a body shows at a joint or two. It is not tried where the best so far, of at least as
  many joints, would be clear of it though it left nothing at its own.
  """
  leaving = {s.joint for s in subjects if may_leave(s, s.explainer.null, settings)}
  shown: list[Wide] = []
  top: Wide | None = None
  for term, members in sorted(wide.hypotheses(model, subjects), key=lambda h: -len(h[1])):
    if term.kind in known or (only and term.kind not in only):
      continue
    if term.target is not None and not any(m.joint in leaving for m in members):
      continue
    if top is not None and (top.evidence() - wide.perfect(members)).clear > _beyond([top]):
      continue
    item = wide.screened(term, members)
    if not _hidden(item, leaving) or item.evidence().by_logs > _beyond([item]):
      shown.append(item)
      if top is None or item.possible().total > top.possible().total:
        top = item
  return _best(shown, certain, leaving, own_latency=subjects[0].before is None)


def _hidden(item: Wide, leaving: Collection[str]) -> bool:
  """Tells whether no joint that an effect concerns leaves more than the machine does anyway."""
  return not any(m.joint in leaving for m in item.members)


def _beyond(items: Sequence[Wide]) -> float:
  """Returns the standard errors that count as clear."""
  return max(m.beyond for item in items for m in item.members)


def _settled(found: Sequence[Shared]) -> list[Shared]:
  """Returns the effects with values that hold beside all others: they were found in turn."""
  settled = list(found)
  for at, item in enumerate(found if len(found) > 1 else ()):
    for member in item.members:
      member.known = tuple(t for t in member.known if t != item.held)
    again = wide.resumed(item.term, item.members, item.x)
    settled[at] = dataclasses.replace(item, x=again.x, reach=_reach(again))
    for member in item.members:
      member.take(settled[at].held)
  return settled


def _reach(item: Wide) -> tuple[Array, Array]:
  spread = intervals.spread(item.fit, [m.now for m in item.members])
  return intervals.reaches(item.fit, spread, (0, len(item.x)))


def _best(
  tried: Sequence[Wide],
  certain: Collection[str],
  leaving: Collection[str],
  *,
  own_latency: bool,
) -> Shared | None:
  """Returns the best of the screened effects if it is clear of all that lack it, or beside them."""
  forms: dict[tuple[str, str | None], Wide] = {}
  for item in sorted(tried, key=lambda w: -w.possible().total):
    forms.setdefault(item.key, item)
  if not forms:
    return None
  top, *others = forms.values()
  beyond = _beyond([top, *others])
  if top.possible().clear < beyond:
    return None
  near = [w for w in others if (top.evidence() - w.possible()).clear < beyond]
  top = wide.adopted(wide.fitted(top), [m for w in near for m in w.members])
  items = sorted([top, *map(wide.fitted, near)], key=lambda w: -w.evidence().total)
  first = items[0].evidence()
  as_likely = float(norm.isf(top.members[0].now.settings.level))
  alike = [w for w in items if (first - w.evidence()).clear < as_likely and wide.same(items[0], w)]
  best = min(alike, key=_how_usual)
  mine = best.evidence()
  single = [wide.alone(best, at) for at in range(len(best.members))]
  most = max(range(len(single)), key=lambda at: single[at][0].total)
  behind = (mine - single[most][0]).clear
  rivals_behind = [_behind(w, best, beyond) for w in items if w not in alike]
  clear = min(
    mine.clear,
    mine.by_logs if _hidden(best, leaving) else np.inf,
    behind if best.term.kind not in certain else np.inf,
    *rivals_behind,
  )
  reach = _reach(best)
  nothing = _is_nothing(best, reach, own_latency=own_latency)
  if clear < beyond or behind < 0.0 or nothing or not _is_new(best):
    return None
  if not is_constant([m.now for m in best.members], best.fit, best.term, beyond):
    return None
  origin = best.members[most]
  or_alone = (behind, single[most][1]) if behind < beyond else None
  twins = tuple((w.term, w.x) for w in alike if w is not best)
  return Shared(best.term, best.x, reach, origin, best.members, clear, mine.total, or_alone, twins)


def _how_usual(item: Wide) -> tuple[int, int]:
  """Returns the order in which effects are named that predict the same: by kind, and of bodies the
  one that fewer joints carry, as that the others feel nothing of it would be a coincidence."""
  kind, _ = item.key
  return USUAL.index(kind) if kind in USUAL else len(USUAL), len(item.members)


def _behind(rival: Wide, best: Wide, beyond: float) -> float:
  """Returns the standard errors by which another effect is behind the best one, or behind itself
  with the best one beside it: where that is clear both are there."""
  behind = (best.evidence() - rival.evidence()).clear
  return behind if behind > beyond else max(behind, wide.beside(best, rival))


def _is_nothing(item: Wide, reach: tuple[Array, Array], *, own_latency: bool) -> bool:
  """Tells whether an effect has sizes only, whose intervals hold the values that do nothing, or are
  as near to them as two recordings of one machine differ in strength."""
  term = item.term
  sizes = {p.name: p.nominal for p in kind_of(term.kind).parameters if not p.shape}
  bounds = intervals.around(term, item.x, *reach, own_latency=own_latency)
  differs = max(_repeated(m) for m in item.members) if term.kind == WEAK else 0.0
  return all(
    n in sizes and low - differs <= sizes[n] <= high + differs for n, (low, high) in bounds.items()
  )


def _repeated(member: Subject) -> float:
  """Returns the share by which a joint's strength may differ between two recordings."""
  own = member.known[0]
  return member.now.settings.sigmas * own.prior[own.names.index("gain")]


def _is_new(item: Wide) -> bool:
  """Tells whether an effect is what has changed, by the logs and references of all its joints
  together (`newness`): else it is the references', too. References of the same commands say so by
  themselves."""
  rows, prior = [], 0.0
  held = item.term.held_at(item.x)
  for at, member in enumerate(item.members):
    if member.before is None or member.paired:
      return True
    terms = (*member.explainer.null.terms, held)
    best = scored_on(member.now, terms, item.own(at), iterations=3)
    gains, more = newness(member, best, held, held)
    rows.append(gains)
    prior += more
  return more_likely(np.concatenate(rows), prior, item.members[0].now.settings.level)


def open_scopes(changed: Sequence[Changed]) -> set[str]:
  """Returns the kinds that one joint's own explanation names while another joint is named by the
  same or stays unexplained, of those that may be a joint's or shared.

  The kind is then certain, and its scopes are alternatives. A kind that no joint is named by must
  be clear of what other kinds do at one joint.
  """
  result = set()
  for one, other in itertools.permutations(changed, 2):
    unexplained = other.verdict == "unexplained"
    result |= {k for k in one.found.named if unexplained or k in other.found.named}
  return result & OPEN


def better(these: Sequence[Changed], others: Sequence[Changed]) -> bool:
  """Tells whether joints' explanations are clearly better than others of the same joints, under the
  present scales: what was found beside others may not be found again from the start."""
  rows, prior = {}, 0.0
  for one, other in zip(these, others, strict=True):
    rows[one.joint] = Row.of(other.found.best, one.found.best).turned()
    prior += one.found.best.prior - other.found.best.prior
  return Evidence(rows, prior).clear > max(c.subject.beyond for c in others)


def with_twins(found: Sequence[Shared], changed: Sequence[Changed]) -> list[Shared]:
  """Returns the shared effects with those that predict the same beside what joints have of their
  own: what is missing yet hides that late commands and late readings do."""
  result = []
  for shared in found:
    if shared.term.kind in wide.LATE and not shared.alike:
      term = wide.twin(shared.term)
      other = dataclasses.replace(term.held_at(shared.x), known=True)
      concerned = [(c.subject, c.found.best) for c in changed if c.joint in shared.joints]
      if all(wide.with_twin(subject, best, shared.held, other) for subject, best in concerned):
        shared = dataclasses.replace(shared, alike=((term, shared.x),))
    result.append(shared)
  return result


def needless(found: Sequence[Shared], changed: Sequence[Changed]) -> list[Shared]:
  """Returns the shared effects without which the joints' explanations do about as well.

  What joints have of their own may look like one effect of all of them. Where more remains at a
  joint than the machine leaves anyway, both have a force of any form beside them there: what is
  named may be a part of what remains.

  Args:
    found: the shared effects.
    changed: the joints' explanations beside them.
  """
  result = []
  for shared in found:
    rows, prior = {}, 0.0
    for item in (c for c in changed if c.joint in shared.joints):
      best = item.found.best
      without = wide.without(item.subject, best, shared.held)
      if item.more_remains:
        best, without = (rivals.beside(item.subject.explainer, s) for s in (best, without))
      rows[item.joint], prior = Row.of(best, without), prior + best.prior - without.prior
    if Evidence(rows, prior).clear < shared.origin.beyond:
      result.append(shared)
  return result
