"""Fits near the best with a richer friction, where more remains than names explain.

Fits of equal cost differ several times over on other motions, as where a joint stops hangs on small
differences of friction. All that are near the best are kept; their mean predicts better than one.
"""

import copy
from collections.abc import Collection

import numpy as np
from scipy.stats import chi2

from nerf2real.sysid.fit.layout import CONSTANTS, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.rich_friction import FORMS, REPLACED, rich_friction
from nerf2real.sysid.hypotheses.terms import FREE, STICKING, Term
from nerf2real.sysid.selection.explain import Explainer, Scored

Array = np.ndarray

_NEAR = 0.95
"""Share of a posterior that lies within so much of the least cost: half a quantile of chi square
with as many degrees as values."""
_MOST = 10  # fits that are judged by logs that they were not fitted to, chosen
_REFITTED = 6  # Jacobians at most of a fit without a fold
_ROUNDS = 2  # of fitting and setting the scale by the best


def elaborated(explainer: Explainer, best: Scored, named: Collection[str]) -> list[Scored]:
  """Returns the fits with richer friction that are near the best of them, the best first; none
  where one without predicts logs better that it was not fitted to.

  Near are those whose cost is, and of them those whose left-out logs are predicted as well.

  Args:
    explainer: of the joint; its scale is set by the best fit, all is scored anew.
    best: the best hypothesis without.
    named: kinds that every one must have.
  """
  joint = explainer.joint
  tried: list[tuple[Fitter, Scored]] = []
  for terms, x in _bases(explainer, best, named):
    for carried in FORMS:
      term = rich_friction(joint.plant, carried)
      fitter = Fitter([joint], Layout([(*terms, term)]))
      for start in term.starts:
        fit = fitter.fit(np.concatenate([x, start]), iterations=3)
        tried.append((fitter, Scored((*terms, term), fit, np.zeros(0))))
  for _ in range(_ROUNDS):
    joint.rescale(min(tried, key=lambda t: t[1].fit.cost)[1].fit.residuals[0])
    for fitter, item in tried:
      item.fit = fitter.fit(item.fit, iterations=3)
  tried.sort(key=lambda t: t[1].fit.cost)
  least = tried[0][1].fit
  reach = 0.5 * float(chi2.ppf(_NEAR, least.layout.count))
  near = [(fitter, s) for fitter, s in tried[:_MOST] if s.fit.cost < least.cost + reach]
  for fitter, item in near:
    item.nats = joint.loglik(fitter.leave_out(item.fit).held[0])
  explainer.rescore()
  nats = {terms: crossed(joint, terms) for terms in dict.fromkeys(s.terms for _, s in near)}
  left_out = sorted(((nats[s.terms], s) for _, s in near), key=lambda pair: -pair[0])
  plain = next(s for s in explainer.ranked() if not s.neutral and s.names >= set(named))
  best_left_out = left_out[0][0]
  if crossed(joint, plain.terms) > best_left_out:
    return []
  return [s for left, s in left_out if left > best_left_out - reach]


def crossed(joint: JointLikelihood, terms: tuple[Term, ...]) -> float:
  """Returns the nats of blocks that a hypothesis was fitted without, fold by fold.

  Every fold's fit begins where the search for its terms does: one that begins at a fit to all of
  the logs, and ends there as costs are rough, has seen what it is left out of.
  """
  layout = Layout([terms])
  fitter, total = Fitter([joint], layout), 0.0
  starts = [
    np.concatenate([t.starts[min(k, len(t.starts) - 1)] for t in terms])
    for k in range(max(len(t.starts) for t in terms))
  ]
  for fold in np.unique(joint.fold):
    part = copy.copy(joint)
    part.gain = joint.gain * (joint.fold != fold)[joint.block_of]
    fits = [Fitter([part], layout).fit(start, iterations=_REFITTED) for start in starts]
    x = min(fits, key=lambda fit: fit.cost).x
    nats = joint.loglik(joint.squares(fitter.simulated(x[None])[1][0][0]))
    total += float(nats[joint.fold == fold].sum())
  return total


def _bases(
  explainer: Explainer, best: Scored, named: Collection[str]
) -> list[tuple[tuple[Term, ...], Array]]:
  """Returns what richer friction is added to: the named effects on constants within tolerances, and
  on freed ones."""
  gone = {FREE, STICKING, "load_friction", *(k for k in REPLACED if k not in named)}
  kept = [
    t
    for t in best.terms
    if t.kind == CONSTANTS or (t.kind not in gone and (t.name is None or t.name in named))
  ]
  x = np.concatenate([list(best.fit.values(t).values()) for t in kept])
  own = {t.kind: t for t in explainer.base}
  tight = tuple(own.get(t.kind, t) if t.kind == CONSTANTS else t for t in kept)
  bases = [(tight, x)]
  if explainer.freed is not None:
    bases.append((tuple(explainer.freed if t.kind == CONSTANTS else t for t in kept), x))
  return bases
