"""Rivals of a name: hypotheses without an effect, with it doing nothing, or with a free force.

They are scored as all others, beside those that an explainer grew.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.free_force import free_force
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.selection.search.explain import Explainer

_PUSH = 0.2  # step of finite differences of a free force, of its values' deviations
_ITERATIONS = 10  # of its fit


def lacking(explainer: Explainer, item: Scored, kind: str) -> Scored:
  """Returns a hypothesis without one of its effects, the constants as tight as they were."""
  instead = {t.kind: t for t in explainer.base}
  terms = tuple(instead.get(t.kind) if t.name == kind else t for t in item.terms)
  kept = tuple(t for t in terms if t is not None)
  if kept not in explainer.scored:
    x = np.concatenate([list(item.fit.values(t).values()) for t in _alike(item.terms, kept)])
    explainer.fitted(kept, x, 4)
  return explainer.scored[kept]


def with_freed(explainer: Explainer, item: Scored) -> Scored:
  """Returns a hypothesis whose constants may differ from what they are taken for."""
  if explainer.freed is None or item.terms[0].freed:
    return item
  terms = (explainer.freed, *item.terms[1:])
  if terms not in explainer.scored:
    explainer.fitted(terms, item.fit.x, 6)
  return explainer.scored[terms]


def with_anothers(explainer: Explainer, best: Scored, rivals: Sequence[Scored]) -> bool:
  """Scores the best hypothesis with each effect that rivals have besides.

  A rival that lacks one of its effects may be ahead by another, which says nothing of the first.

  Args:
    explainer: scores what has not been scored.
    best: the hypothesis.
    rivals: of its effects.

  Returns:
    Whether any had not been scored.
  """
  scored = {s.names for s in explainer.scored.values() if not (s.neutral or s.beside_force)}
  others = {kind for rival in rivals for kind in rival.names - best.names}
  wanted = [kind for kind in sorted(others) if best.names | {kind} not in scored]
  for kind in wanted:
    explainer.extend(best, 1, only=kind)
  return bool(wanted)


def _alike(given: Sequence[Term], wanted: Sequence[Term]) -> list[Term]:
  """Returns the given terms that are of the wanted ones' kinds and fitted there, in their order."""
  by_kind = {t.kind: t for t in given}
  return [by_kind[t.kind] for t in wanted if t.names]


def with_force(explainer: Explainer, parent: Scored, along: str | None = None) -> Scored:
  """Returns a hypothesis with a force of any form beside it.

  The force's derivatives are taken once, at the first of these hypotheses.

  Args:
    explainer: scores what has not been scored.
    parent: the hypothesis.
    along: "position" or "velocity" for a force over that alone.
  """
  force = free_force(explainer.joint.plant, along)
  terms = (*parent.terms, force)
  if terms in explainer.scored:
    return explainer.scored[terms]
  fitter = Fitter([explainer.joint], Layout([terms]))
  count = len(parent.fit.x)
  x = np.concatenate([parent.fit.x, force.starts[0]])
  if not set(force.names) <= explainer.pushes.keys():
    blank = np.zeros((len(x), *parent.fit.residuals[0].shape))
    fresh, here = np.arange(len(x)) >= count, parent.fit.residuals
    pushed = fitter.linearise(x, _PUSH, [blank], fresh, here).jacobian[0][count:]
    explainer.pushes = dict(zip(force.names, pushed, strict=True))
  pushes = np.array([explainer.pushes[name] for name in force.names])
  known = [np.concatenate([parent.fit.jacobian[0], pushes])]
  fresh = np.arange(len(x)) < count
  begin = fitter.weighed(x, parent.fit.residuals, known, None)
  fit = fitter.fit(begin, iterations=_ITERATIONS, known=known, fresh=fresh)
  return explainer.score(terms, fitter.fit(fitter.linearise(fit.x, _PUSH), iterations=2))


def beside(explainer: Explainer, parent: Scored) -> Scored:
  """Returns a hypothesis with a force of any form, which is not kept among those of the joint."""
  kept = dict(explainer.scored)
  found = with_force(explainer, parent)
  explainer.scored = kept
  return found


def beside_force(explainer: Explainer, best: Scored) -> None:
  """Scores a force of any form alone and beside the best set of effects, and the scale anew."""
  parents = {id(i): i for i in (explainer.null, best)}.values()
  top = max((with_force(explainer, p) for p in parents), key=lambda item: item.evidence)
  if top.evidence > best.evidence:
    explainer.joint.rescale(top.fit.residuals[0])
    explainer.rescore()


def neutralise(explainer: Explainer, item: Scored) -> None:
  """Scores an item with each of its effects at the values that do nothing, all else fitted.

  What an effect brings along (a friction constraint without creep, a better place from which the
  constants were fitted) is no evidence for it.
  """
  scored = explainer.scored
  for term in (t for t in item.terms if t.name is not None):
    before = next((t for t in explainer.base if t.kind == term.kind), None)
    instead = before or term.at_rest(item.fit.values(term))
    terms = tuple(instead if t is term else t for t in item.terms)
    x = np.concatenate(
      [
        [v for n, v in item.fit.values(t).items() if t is not term or n in instead.names]
        for t in item.terms
      ]
    )
    fit = Fitter([explainer.joint], Layout([terms])).fit(x, iterations=4)
    if terms not in scored or explainer.cost(scored[terms]) > fit.cost:
      explainer.score(terms, fit, neutral=before is None)
    plain = scored.get(tuple(t for t in item.terms if t is not term))
    enough = explainer.settings.settled
    if plain is not None and before is None and fit.cost < explainer.cost(plain) - enough:
      again = Fitter([explainer.joint], Layout([plain.terms])).fit(fit.x, iterations=4)
      if again.cost < explainer.cost(plain):
        explainer.score(plain.terms, again)
