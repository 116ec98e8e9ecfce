"""Explains one joint: sets of effects grown forward, scored by left-out likelihood."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from nerf2real.sysid.fit.layout import Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.free_force import free_force
from nerf2real.sysid.hypotheses.terms import FREE, Term
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_PUSH = 0.2  # step of finite differences of a free force, of its values' deviations
_ITERATIONS = 10  # of its fit
_LOOKS = 2  # rounds of fitting constants in which other latencies are looked at
_SCREENED = 2  # times as many kinds as are fitted to the end take a second step
_SETTLED = 0.5  # nats that a fit under a new scale gains at which both have settled


UNREPEATED = ("backlash",)
"""Kinds under which a course does not repeat: which way teeth bounce depends on microradians."""


@dataclasses.dataclass
class Scored:
  """A fitted hypothesis of one joint, with its evidence."""

  terms: tuple[Term, ...]
  fit: Fit
  nats: Array
  """[B] log-likelihood of the left-out blocks."""
  neutral: bool = False
  """Whether an effect stands at the values that do nothing: a rival, never an explanation."""

  @property
  def names(self) -> frozenset[str]:
    """Kinds of its effects."""
    return named(self.terms)

  @property
  def beside_force(self) -> bool:
    """Whether a force of any form is among its terms."""
    return any(t.kind == FREE for t in self.terms)

  def values(self, kind: str) -> dict[str, float]:
    """Returns the values of the term of a kind by name; empty if it has none."""
    term = next((t for t in self.terms if t.kind == kind), None)
    return {} if term is None else self.fit.values(term)

  @property
  def evidence(self) -> float:
    """Sum of the blocks' nats, less what the priors cost."""
    return float(self.nats.sum()) - self.prior

  @property
  def prior(self) -> float:
    """What the priors cost, nats."""
    sigma, centre = self.fit.layout.sigma, self.fit.layout.centre
    return 0.5 * float(np.sum(((self.fit.x - centre) / sigma) ** 2))


def named(terms: Sequence[Term]) -> frozenset[str]:
  """Returns the kinds of effects that are not the machine's anyway."""
  return frozenset(t.name for t in terms if t.name is not None)


def clear(better: Scored, other: Scored) -> float:
  """Returns how clear a difference of evidence is, in its standard errors (Vuong 1989).

  The blocks' differences are paired; neighbours may be correlated.
  """
  d = better.nats - other.nats
  return standardised(d, better.evidence - other.evidence, 1.0)


def standardised(differences: Array, total: float | None = None, least: float = 1e-300) -> float:
  """Returns a sum of blocks' differences over its standard error."""
  total = float(differences.sum()) if total is None else total
  return total / max(np.sqrt(variance(differences)), least)


def variance(differences: Array) -> float:
  """Returns the variance of a sum of blocks' differences, of which neighbours may go together."""
  e = differences - differences.mean()
  own = float(e @ e)
  return max(own + 2.0 * float(e[1:] @ e[:-1]), own) * len(e) / max(len(e) - 1, 1)


def of_size(items: Iterable[Scored], size: int) -> list[Scored]:
  """Returns the explanations by a number of effects alone."""
  alone = (item for item in items if not (item.neutral or item.beside_force))
  return [item for item in alone if len(item.names) == size]


def _alike(given: Sequence[Term], wanted: Sequence[Term]) -> list[Term]:
  """Returns the given terms that are of the wanted ones' kinds and fitted there, in their order."""
  by_kind = {t.kind: t for t in given}
  return [by_kind[t.kind] for t in wanted if t.names]


def _best_of_kinds(
  tried: Sequence[tuple[Fitter, tuple[Term, ...], Fit]],
) -> list[tuple[Fitter, tuple[Term, ...], Fit]]:
  """Returns the best form of every set of kinds, the best first."""
  chosen: dict[frozenset[str], tuple[Fitter, tuple[Term, ...], Fit]] = {}
  for item in sorted(tried, key=lambda t: t[2].cost):
    chosen.setdefault(named(item[1]), item)
  return list(chosen.values())


class Explainer:
  """Grows hypotheses of one joint."""

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
  ):
    """Fits the constants, setting the residual's scale as they improve.

    Args:
      joint: the logs.
      constants: that every hypothesis varies.
      library: effects to try.
      settings: effort.
      start: of the constants.
      known: effects that every hypothesis has.
      freed: constants that may differ from those of a reference.
    """
    self.joint, self.constants, self.settings = joint, constants, settings
    self.library, self.freed = list(library), freed
    self.scored: dict[tuple[Term, ...], Scored] = {}
    self.base = base = (constants, *known)
    x = np.concatenate([t.starts[0] for t in base]) if start is None else start
    declared = joint.residuals((), np.zeros((1, 0)))[0]
    joint.rescale(declared)
    fitter = Fitter([joint], Layout([base]))
    fit, left = fitter.fit(x, iterations=2), np.inf
    for count in range(self.settings.rounds):
      if count < _LOOKS:
        fit = fitter.look_about(fit, ("latency", "skew"), iterations=1)
      joint.rescale(fit.residuals[0])
      before, left = left, float(np.log(joint.scale).sum())
      if left > before - 0.01:
        break
      fit = fitter.fit(fit, iterations=2)
    self.null = self._score(base, fitter.fit(fit, iterations=4))
    bare = Fitter([joint], Layout([()])).linearise(np.zeros(0), 0.0)
    self.declared = self._score((), bare, neutral=True)
    self._pushes: dict[str, Array] = {}

  def _score(self, terms: tuple[Term, ...], fit: Fit, *, neutral: bool = False) -> Scored:
    fitter = Fitter([self.joint], Layout([terms]))
    fitter.leave_out(fit)
    result = Scored(terms, fit, self.joint.loglik(fit.held[0]), neutral)
    self.scored[terms] = result
    return result

  def rescore(self) -> None:
    """Scores all hypotheses anew after the scale has changed."""
    for s in self.scored.values():
      s.nats = self.joint.loglik(s.fit.held[0])

  def cost(self, item: Scored) -> float:
    """Returns the negative log posterior of a hypothesis under the present scale."""
    nats = self.joint.loglik(self.joint.squares(item.fit.residuals[0]))
    return item.prior - float(nats.sum())

  def extend(self, parent: Scored, keep: int) -> list[Scored]:
    """Returns the best hypotheses that add one effect to a parent, fitted to the end."""
    tried: list[tuple[Fitter, tuple[Term, ...], Fit]] = []
    for terms, starts, stale, fresh in self._candidates(parent):
      fitter = Fitter([self.joint], Layout([terms]))
      fits = [
        fitter.fit(
          fitter.linearise(x, known=stale, fresh=fresh, residuals=rows), iterations=1, quick=True
        )
        for x, rows in self._begin(parent, fitter, starts)
      ]
      tried.append((fitter, terms, min(fits, key=lambda f: f.cost)))
    leading = _best_of_kinds(tried)[: _SCREENED * keep]  # halving: who leads takes another step
    tried = [
      (fitter, terms, fitter.fit(fit, iterations=1, quick=True))
      for fitter, terms, fit in tried
      if any(named(terms) == named(other) for _, other, _ in leading)
    ]
    chosen = _best_of_kinds(tried)
    return [
      self._score(terms, fitter.look_about(fitter.fit(fit, iterations=4), ("delay",)))
      for fitter, terms, fit in chosen[:keep]
    ]

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
    old = [t.kind for t in parent.terms]
    at = 0
    for position, term in enumerate(parent.terms):  # an effect that references show may be larger
      count = len(term.names)
      if term.known:
        free = next(
          (t for t in self.library if t.kind == term.kind and t.fixed == term.fixed), None
        )
        if free is not None:
          terms = (*parent.terms[:position], free, *parent.terms[position + 1 :])
          starts = [x]
          for factor in (0.5, 1.5, 3.0):
            starts.append(x.copy())
            starts[-1][at] *= factor
          fresh = np.zeros(len(x), bool)
          fresh[at : at + count] = True
          yield terms, np.array(starts), [known], fresh
      at += count
    if self.freed is not None and not parent.terms[0].freed:
      fresh = np.zeros(len(x), bool)
      fresh[: len(self.freed.names)] = True
      yield (self.freed, *parent.terms[1:]), x[None], [known], fresh
    for term in self.library:
      if term.kind in old:
        continue
      blank = np.zeros((len(term.names), *known.shape[1:]))
      begin = np.array([np.concatenate([x, s]) for s in term.starts])
      fresh = np.arange(begin.shape[1]) >= len(x)
      yield (*parent.terms, term), begin, [np.concatenate([known, blank])], fresh

  def lacking(self, item: Scored, kind: str) -> Scored:
    """Returns a hypothesis without one of its effects, the constants as tight as they were."""
    instead = {t.kind: t for t in self.base}
    terms = tuple(instead.get(t.kind) if t.name == kind else t for t in item.terms)
    kept = tuple(t for t in terms if t is not None)
    if kept not in self.scored:
      x = np.concatenate([list(item.fit.values(t).values()) for t in _alike(item.terms, kept)])
      self._score(kept, Fitter([self.joint], Layout([kept])).fit(x, iterations=4))
    return self.scored[kept]

  def with_force(self, parent: Scored, along: str | None = None) -> Scored:
    """Returns a hypothesis with a force of any form beside it, whose derivatives are taken once at
    first.

    Args:
      parent: the hypothesis.
      along: "position" or "velocity" for a force over that alone.
    """
    force = free_force(self.joint.plant, along)
    terms = (*parent.terms, force)
    if terms in self.scored:
      return self.scored[terms]
    fitter = Fitter([self.joint], Layout([terms]))
    count = len(parent.fit.x)
    x = np.concatenate([parent.fit.x, force.starts[0]])
    if not set(force.names) <= self._pushes.keys():
      blank = np.zeros((len(x), *parent.fit.residuals[0].shape))
      fresh, here = np.arange(len(x)) >= count, parent.fit.residuals
      pushed = fitter.linearise(x, _PUSH, [blank], fresh, here).jacobian[0][count:]
      self._pushes = dict(zip(force.names, pushed, strict=True))
    pushes = np.array([self._pushes[name] for name in force.names])
    known = [np.concatenate([parent.fit.jacobian[0], pushes])]
    fresh = np.arange(len(x)) < count
    begin = fitter.weighed(x, parent.fit.residuals, known, None)
    fit = fitter.fit(begin, iterations=_ITERATIONS, known=known, fresh=fresh)
    return self._score(terms, fitter.fit(fitter.linearise(fit.x, _PUSH), iterations=2))

  def constants_alone(self) -> list[Scored]:
    """Returns the hypotheses that differ in the constants' freedom alone, the best first."""
    if self.freed is not None:
      terms = (self.freed, *self.null.terms[1:])
      fitter = Fitter([self.joint], Layout([terms]))
      self._score(terms, fitter.fit(self.null.fit.x, iterations=4))
    return self.ranked()

  def adopt(self, best: Scored) -> Scored:
    """Sets the scale by the best hypothesis as it improves; returns it, all are scored anew."""
    fitter = Fitter([self.joint], Layout([best.terms]))
    for _ in range(self.settings.rounds):
      self.joint.rescale(best.fit.residuals[0])
      before = fitter.again(best.fit).cost
      best = self._score(
        best.terms, fitter.look_about(fitter.fit(best.fit, iterations=4), ("delay",))
      )
      if best.fit.cost > before - _SETTLED:
        break
    if self.joint.follows and best.names & set(UNREPEATED):
      fitter = Fitter([self.joint], Layout([best.terms]))
      best = self._score(best.terms, fitter.fit(fitter.draw(best.fit).x, iterations=8))
      self.joint.rescale(best.fit.residuals[0])
    self.rescore()
    return best

  def refit(self, item: Scored, iterations: int = 6) -> Scored:
    """Returns a hypothesis fitted on under the present scale."""
    fit = Fitter([self.joint], Layout([item.terms])).fit(item.fit, iterations=iterations)
    return self._score(item.terms, fit)

  def explain(
    self, depth: int | None = None, leaves: Callable[[Scored], bool] = lambda _: False
  ) -> list[Scored]:
    """Grows sets of effects until one more is not clear; returns all scored, the best first.

    Args:
      depth: effects at most; those of the settings for None.
      leaves: whether a hypothesis leaves more than a machine does anyway: then one more is tried as
        long as it predicts what was left out better, too.
    """
    s, limit = self.settings, depth or self.settings.depth
    parents, best = [self.null], self.null
    for depth in range(limit):
      grown = [g for p in parents for g in self.extend(p, s.kept)]
      if not grown:
        break
      top = max(grown, key=lambda g: g.evidence)
      if top.evidence > best.evidence:
        top = self.adopt(top)
        if depth == 0:
          self.null = self.refit(self.null)
        for item in sorted(grown, key=lambda g: -g.evidence)[: s.kept]:
          if item.terms != top.terms:
            self.refit(item, 3)
      grown = sorted(of_size(self.scored.values(), depth + 1), key=lambda g: -g.evidence)
      better = grown[0].evidence > best.evidence and leaves(best)
      if clear(grown[0], best) < s.worth and not better:
        break
      best = grown[0]
      parents = [g for g in grown[: s.parents] if clear(best, g) < s.worth]
    for size in {len(item.names) for item in self.scored.values()}:
      same = of_size(self.scored.values(), size)
      if same:
        self._neutralise(max(same, key=lambda item: item.evidence))
    if leaves(best):
      self._beside_force(best)
    return self.ranked()

  def _beside_force(self, best: Scored) -> None:
    """Scores a force of any form alone and beside the best set of effects, and the scale anew."""
    forced = [self.with_force(parent) for parent in {id(i): i for i in (self.null, best)}.values()]
    top = max(forced, key=lambda item: item.evidence)
    if top.evidence > best.evidence:
      self.joint.rescale(top.fit.residuals[0])
      self.rescore()

  def _neutralise(self, item: Scored) -> None:
    """Scores an item with each of its effects at the values that do nothing, all else fitted.

    What an effect brings along (a friction constraint without creep, a better place from which the
    constants were fitted) is no evidence for it.
    """
    for term in (t for t in item.terms if t.name is not None):
      before = next((t for t in self.base if t.kind == term.kind), None)
      instead = before or term.at_rest(item.fit.values(term))
      terms = tuple(instead if t is term else t for t in item.terms)
      x = np.concatenate(
        [
          [v for n, v in item.fit.values(t).items() if t is not term or n in instead.names]
          for t in item.terms
        ]
      )
      fit = Fitter([self.joint], Layout([terms])).fit(x, iterations=4)
      if terms not in self.scored or self.cost(self.scored[terms]) > fit.cost:
        self._score(terms, fit, neutral=before is None)
      plain = self.scored.get(tuple(t for t in item.terms if t is not term))
      if plain is not None and before is None and fit.cost < self.cost(plain) - _SETTLED:
        again = Fitter([self.joint], Layout([plain.terms])).fit(fit.x, iterations=4)
        if again.cost < self.cost(plain):
          self._score(plain.terms, again)

  def ranked(self) -> list[Scored]:
    """Returns all scored hypotheses, the best first."""
    return sorted(self.scored.values(), key=lambda s: -s.evidence)
