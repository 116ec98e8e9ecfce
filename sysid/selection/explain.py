"""Explains one joint: sets of effects grown forward, scored by left-out likelihood."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fit, Fitter, Layout
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

_SETTLED = 0.5  # nats that a fit under a new scale gains at which both have settled


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
  """Returns the explanations with a number of effects."""
  return [item for item in items if len(item.names) == size and not item.neutral]


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
    left = np.inf
    for _ in range(self.settings.rounds):
      fit = self._look_about(fitter, fitter.fit(x, iterations=2))
      joint.rescale(fit.residuals[0])
      x, before, left = fit.x, left, float(np.log(joint.scale).sum())
      if left > before - 0.01:
        break
    self.null = self._score(base, fitter.fit(x, iterations=4))

  def _look_about(self, fitter: Fitter, fit: Fit) -> Fit:
    """Returns a fit from a better place if there is one: held commands make stairs of latencies."""
    tried = []
    for at, name in enumerate(self.constants.names):
      if name in ("latency", "skew"):
        for value in np.arange(-3, 5) * 0.002:
          tried.append(fit.x.copy())
          tried[-1][at] = np.clip(value, fitter.layout.low[at], fitter.layout.high[at])
    costs = fitter.costs(np.array(tried))
    best = int(np.argmin(costs))
    return fitter.fit(tried[best], iterations=1) if costs[best] < fit.cost - 1.0 else fit

  def _score(self, terms: tuple[Term, ...], fit: Fit, *, neutral: bool = False) -> Scored:
    fitter = Fitter([self.joint], Layout([terms]))
    fitter.leave_out(fit)
    result = Scored(terms, fit, self.joint.loglik(fit.held[0]), neutral)
    self.scored[terms] = result
    return result

  def _rescore(self) -> None:
    """Scores all hypotheses anew after the scale has changed."""
    for s in self.scored.values():
      s.nats = self.joint.loglik(s.fit.held[0])

  def extend(self, parent: Scored, keep: int) -> list[Scored]:
    """Returns the best hypotheses that add one effect to a parent, fitted to the end."""
    quick: list[tuple[float, tuple[Term, ...], Fit]] = []
    for terms, starts, stale, fresh in self._candidates(parent):
      fitter = Fitter([self.joint], Layout([terms]))
      best = None
      for start in self._begin(parent, fitter, starts):
        fit = fitter.fit(start, iterations=2, known=stale, fresh=fresh, quick=True)
        if best is None or fit.cost < best.cost:
          best = fit
      assert best is not None
      quick.append((best.cost, terms, best))
    quick.sort(key=lambda q: q[0])
    chosen: dict[frozenset[str], tuple[float, tuple[Term, ...], Fit]] = {}
    for q in quick:  # the best form of every kind
      chosen.setdefault(named(q[1]), q)
    results = []
    for _, terms, fit in list(chosen.values())[:keep]:
      done = Fitter([self.joint], Layout([terms])).fit(fit.x, iterations=4)
      results.append((terms, done if done.cost < fit.cost + 1.0 else fit))
    return [self._score(terms, fit) for terms, fit in results]

  def _begin(self, parent: Scored, fitter: Fitter, starts: Array) -> list[Array]:
    """Returns where descents begin: the best start, and without a first effect the best one with
    the constants as they were declared, which what is missing may have bent."""
    begin = [starts[int(np.argmin(fitter.costs(starts)))]]
    if not parent.names:
      declared = starts.copy()
      count = len(parent.fit.x)
      declared[:, :count] = np.concatenate([t.centre for t in self.base])
      begin.append(declared[int(np.argmin(fitter.costs(declared)))])
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

  def constants_alone(self) -> list[Scored]:
    """Returns the hypotheses that differ in the constants' freedom alone, the best first."""
    if self.freed is not None:
      terms = (self.freed, *self.null.terms[1:])
      self._score(terms, Fitter([self.joint], Layout([terms])).fit(self.null.fit.x, iterations=4))
    return self.ranked()

  def adopt(self, best: Scored) -> Scored:
    """Sets the scale by the best hypothesis as it improves; returns it, all are scored anew."""
    fitter = Fitter([self.joint], Layout([best.terms]))
    for _ in range(self.settings.rounds):
      self.joint.rescale(best.fit.residuals[0])
      before = float(fitter.costs(best.fit.x[None])[0])
      best = self.refit(best, 4)
      if best.fit.cost > before - _SETTLED:
        break
    self._rescore()
    return best

  def refit(self, item: Scored, iterations: int = 6) -> Scored:
    """Returns a hypothesis fitted on under the present scale."""
    fit = Fitter([self.joint], Layout([item.terms])).fit(item.fit.x, iterations=iterations)
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
      grown = sorted(
        (g for g in self.scored.values() if len(g.names) == depth + 1), key=lambda g: -g.evidence
      )
      better = grown[0].evidence > best.evidence and leaves(best)
      if clear(grown[0], best) < s.worth and not better:
        break
      best = grown[0]
      parents = [g for g in grown[: s.parents] if clear(best, g) < s.worth]
    for size in {len(item.names) for item in self.scored.values()}:
      self._neutralise(max(of_size(self.scored.values(), size), key=lambda item: item.evidence))
    return self.ranked()

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
      if terms not in self.scored or self.scored[terms].fit.cost > fit.cost:
        self._score(terms, fit, neutral=before is None)

  def ranked(self) -> list[Scored]:
    """Returns all scored hypotheses, the best first."""
    return sorted(self.scored.values(), key=lambda s: -s.evidence)
