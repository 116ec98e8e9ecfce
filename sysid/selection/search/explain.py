"""Fits sets of effects of one joint and scores them by left-out likelihood."""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit import rough
from nerf2real.sysid.fit.layout import CONSTANTS, Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.terms import WEAK, Term
from nerf2real.sysid.selection.search.beginnings import beginnings
from nerf2real.sysid.selection.search.evidence import UNREPEATED, Scored, kinds_of
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_LOOKS = 2  # rounds of fitting constants in which other latencies are looked at
_SCREENED = 2  # times as many kinds as are fitted to the end take a second step
_OF_KNOWN = (1.0, 0.5, 1.5, 3.0)  # times its size in a reference, where an effect's search starts


def _best_of_kinds(
  tried: Sequence[tuple[Fitter, tuple[Term, ...], Fit]],
) -> list[tuple[Fitter, tuple[Term, ...], Fit]]:
  """Returns the best form of every set of kinds by what its next step promises, the best first."""
  chosen: dict[frozenset[str], tuple[Fitter, tuple[Term, ...], Fit]] = {}
  for item in sorted(tried, key=lambda t: t[2].cost - t[0].promised(t[2])):
    chosen.setdefault(kinds_of(item[1]), item)
  return list(chosen.values())


def scored_on(
  joint: JointLikelihood, terms: tuple[Term, ...], x: Array, *, iterations: int
) -> Scored:
  """Returns a hypothesis fitted on from values [n], scored on left-out blocks and kept nowhere."""
  fitter = Fitter([joint], Layout([terms]))
  fit = fitter.leave_out(fitter.fit(x, iterations=iterations))
  return Scored(joint, terms, fit, joint.loglik(fit.held[0]))


class Explainer:
  """Fits and scores hypotheses of one joint, and those that have one effect more."""

  def __init__(
    self,
    joint: JointLikelihood,
    constants: Term,
    library: Sequence[Term],
    *,
    settings: Settings = SETTINGS,
    start: Array | None = None,
    known: Sequence[Term] = (),
    freed: Term | None = None,
    changed: Sequence[Term] = (),
  ):
    """Fits the constants, setting the residual's scale as they improve.

    Args:
      joint: the logs.
      constants: that every hypothesis varies.
      library: effects to try.
      settings: effort.
      start: of the constants.
      known: effects that every hypothesis has.
      freed: constants that may differ from what they are taken for.
      changed: the same, each of which frees some of them; `freed` alone if empty.
    """
    self.joint, self.constants, self.settings = joint, constants, settings
    self.library, self.freed = list(library), freed
    self.changed = tuple(changed) or ((freed,) if freed is not None else ())
    self.scored: dict[tuple[Term, ...], Scored] = {}
    self.base = base = (constants, *known)
    x = np.concatenate([t.starts[0] for t in base]) if start is None else start
    declared = joint.residuals((), np.zeros((1, 0)))[0]
    joint.rescale(declared)
    fitter = Fitter([joint], Layout([base]))
    fit, left = fitter.fit(x, iterations=2), np.inf
    for count in range(self.settings.rounds):
      if count < _LOOKS:
        fit = rough.look_about(fitter, fit, ("latency", "skew"), iterations=1)
      joint.rescale(fit.residuals[0])
      before, left = left, float(np.log(joint.scale).sum())
      if left > before - 0.01:
        break
      fit = fitter.fit(fit, iterations=2)
    self.null = self.score(base, fitter.fit(fit, iterations=4))
    bare = Fitter([joint], Layout([()])).linearise(np.zeros(0), 0.0)
    self.declared = self.score((), bare, neutral=True)
    self.pushes: dict[str, Array] = {}

  def score(self, terms: tuple[Term, ...], fit: Fit, *, neutral: bool = False) -> Scored:
    fitter = Fitter([self.joint], Layout([terms]))
    fitter.leave_out(fit)
    result = Scored(self.joint, terms, fit, self.joint.loglik(fit.held[0]), neutral)
    self.scored[terms] = result
    return result

  def fitted(self, terms: tuple[Term, ...], x: Array | Fit, iterations: int) -> Scored:
    """Returns a hypothesis fitted on from values [n], or from a fit, and scored."""
    fit = Fitter([self.joint], Layout([terms])).fit(x, iterations=iterations)
    return self.score(terms, fit)

  def rescore(self) -> None:
    """Scores all hypotheses anew after the scale has changed, the baseline among them."""
    for s in (self.null, *self.scored.values()):
      s.nats = self.joint.loglik(s.fit.held[0])

  def cost(self, item: Scored) -> float:
    """Returns the negative log posterior of a hypothesis under the present scale."""
    nats = self.joint.loglik(self.joint.squares(item.fit.residuals[0]))
    return item.prior - float(nats.sum())

  def extend(
    self, parent: Scored, keep: int, only: str | None = None, *, forms: bool = False
  ) -> list[Scored]:
    """Returns the best hypotheses that add one effect to a parent, fitted to the end.

    Args:
      parent: the hypothesis.
      keep: of how many kinds.
      only: the one kind that is tried; None for all.
      forms: whether the parent's effects are tried in their other forms, too.
    """
    tried: list[tuple[Fitter, tuple[Term, ...], Fit]] = []
    parents = (parent, *(self._other_forms(parent) if forms else ()))
    for terms, starts, stale, fresh in (c for p in parents for c in self._candidates(p)):
      if only is not None and only not in kinds_of(terms):
        continue
      fitter = Fitter([self.joint], Layout([terms]))
      for x, rows in self._begin(parent, fitter, starts):
        begun = fitter.linearise(x, known=stale, fresh=fresh, residuals=rows)
        tried.append((fitter, terms, fitter.fit(begun, iterations=1, quick=True)))
    leading = _best_of_kinds(tried)[: _SCREENED * keep]  # halving: who leads takes another step
    tried = [
      (fitter, terms, fitter.fit(fit, iterations=1, quick=True))
      for fitter, terms, fit in tried
      if any(kinds_of(terms) == kinds_of(other) for _, other, _ in leading)
    ]
    chosen = _best_of_kinds(tried)
    return [
      self.score(terms, rough.look_about(fitter, fitter.fit(fit, iterations=4), rough.STAIRS))
      for fitter, terms, fit in chosen[:keep]
    ]

  def take_over(self, other: Scored) -> Scored:
    """Returns the hypothesis of another explainer of the joint, fitted on and scored here."""
    own = [t for t in other.terms if t in self.library]
    first = self.freed if other.terms[0].freed and self.freed is not None else self.constants
    instead = {t.kind for t in own}
    known = [t for t in self.base[1:] if t.wider or t.kind not in instead]
    terms = (first, *known, *own)
    x = []
    for term in terms:
      twin = next((t for t in other.terms if t == term or t.kind == term.kind == CONSTANTS), None)
      values = {} if twin is None else other.fit.values(twin)
      x += [values.get(name, at) for name, at in zip(term.names, term.starts[0], strict=True)]
    return self.fitted(terms, np.array(x), 8)

  def _other_forms(self, parent: Scored) -> list[Scored]:
    """Returns a hypothesis with each of its effects in the other forms that its kind has, where
    they predict another motion: one that is worse alone may be the better one beside another."""
    found = []
    for at, term in enumerate(parent.terms):
      for form in self.library if term in self.library else ():
        if form.kind != term.kind or form.names != term.names or form.fixed == term.fixed:
          continue
        terms = (*parent.terms[:at], form, *parent.terms[at + 1 :])
        if terms not in self.scored:
          self.fitted(terms, parent.fit.x, 4)
        item = self.scored[terms]
        if not self.joint.alike(item.fit.residuals[0] - parent.fit.residuals[0]):
          found.append(item)
    return found

  def _begin(
    self, parent: Scored, fitter: Fitter, starts: Array
  ) -> list[tuple[Array, list[Array]]]:
    """Returns where descents begin, with the residuals there: the best start, and without a first
    effect the best one with the constants as they were declared, which what is missing may have
    bent."""
    places = [starts]
    if not parent.names:
      places.append(starts.copy())
      places[-1][:, : len(parent.fit.x)] = np.concatenate([t.centre for t in self.base])
    begin = []
    for place in places:
      costs, rows = fitter.simulated(place)
      best = int(np.argmin(costs))
      begin.append((place[best], [row[best] for row in rows]))
    return begin

  def _candidates(self, parent: Scored):
    """Yields terms, starts [S, n], a Jacobian to take over and which values are new [n]."""
    known, x = parent.fit.jacobian[0], parent.fit.x
    # A weak joint is weak beside a low supply, which all have: their factors multiply.
    old = [t.kind for t in parent.terms if not (t.wider and t.kind == WEAK)]
    at = 0
    # An effect that references show may be larger, or of another form.
    for position, term in enumerate(parent.terms):
      count = len(term.names)
      for free in self.library if term.known else ():
        if free.kind != term.kind or free.names != term.names:
          continue
        terms = (*parent.terms[:position], free, *parent.terms[position + 1 :])
        here = x[at : at + count]
        places = [np.array(start) for start in free.starts]
        if free.fixed == term.fixed:
          places += [np.append(factor * here[0], here[1:]) for factor in _OF_KNOWN]
        starts = np.tile(x, (len(places), 1))
        starts[:, at : at + count] = places
        fresh = np.zeros(len(x), bool)
        fresh[at : at + count] = True
        yield terms, starts, [known], fresh
      at += count
    for freed in () if parent.terms[0].freed else self.changed:
      fresh = np.arange(len(x)) < len(freed.names)
      before, *others = np.array(freed.starts)
      begin = np.tile(x, (1 + len(others), 1))
      for row, start in zip(begin[1:], others, strict=True):
        row[fresh] = np.where(start != before, start, row[fresh])
      yield (freed, *parent.terms[1:]), begin, [known], fresh
    for term in self.library:
      if term.kind in old:
        continue
      blank = np.zeros((len(term.names), *known.shape[1:]))
      begin = beginnings(parent, term)
      fresh = np.arange(begin.shape[1]) >= len(x)
      yield (*parent.terms, term), begin, [np.concatenate([known, blank])], fresh

  def constants_alone(self) -> list[Scored]:
    """Returns the hypotheses that differ in the constants' freedom alone, the best first."""
    if self.freed is not None:
      self.fitted((self.freed, *self.null.terms[1:]), self.null.fit.x, 4)
    return self.ranked()

  def adopt(self, best: Scored) -> Scored:
    """Sets the scale by the best hypothesis as it improves; returns it, all are scored anew."""
    fitter = Fitter([self.joint], Layout([best.terms]))
    for _ in range(self.settings.rounds):
      self.joint.rescale(best.fit.residuals[0])
      before = fitter.again(best.fit).cost
      best = self.score(
        best.terms, rough.look_about(fitter, fitter.fit(best.fit, iterations=4), rough.STAIRS)
      )
      if best.fit.cost > before - self.settings.settled:
        break
    if self.joint.follows and best.names & set(UNREPEATED):
      drawn = self.fitted(best.terms, rough.draw(fitter, best.fit).x, 8)
      best = max(drawn, best, key=lambda item: item.evidence)
      self.scored[best.terms] = best
      self.joint.rescale(best.fit.residuals[0])
    self.rescore()
    return best

  def refit(self, item: Scored, iterations: int = 6) -> Scored:
    """Returns a hypothesis fitted on under the present scale."""
    return self.fitted(item.terms, item.fit, iterations)

  def ranked(self) -> list[Scored]:
    """Returns all scored hypotheses, the best first."""
    return sorted(self.scored.values(), key=lambda s: -s.evidence)
