"""Grows sets of effects until one more is not clear, exchanges them, and scores their rivals."""

from collections.abc import Callable, Sequence

from scipy.stats import norm

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.search.evidence import Scored, clear, of_size
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.selection.search.rivals import beside_force, lacking, neutralise

_EXCHANGES = 3  # rounds at most in which an effect is exchanged for another


def grow(
  explainer: Explainer,
  depth: int | None = None,
  leaves: Callable[[Scored], bool] = lambda _: False,
  also: Sequence[Scored] = (),
) -> list[Scored]:
  """Returns all scored hypotheses, the best first.

  Args:
    explainer: of the joint, with its constants fitted.
    depth: effects at most; those of the settings for None.
    leaves: whether a hypothesis leaves more than a machine does anyway: then one more is tried as
      long as it predicts what was left out better, too. Where an effect's constants are strained,
      as they take what another does, it need be clear at the level itself only.
    also: hypotheses of another explainer of the joint, which compete with what was grown.
  """
  s, limit = explainer.settings, depth or explainer.settings.depth
  parents, best = [explainer.null], explainer.null
  extended = set[tuple[Term, ...]]()
  for size in range(limit):
    grown = [g for p in parents for g in explainer.extend(p, s.kept, forms=leaves(best))]
    extended |= {p.terms for p in parents}
    if not grown:
      break
    top = max(grown, key=lambda g: g.evidence)
    if top.evidence > best.evidence:
      top = explainer.adopt(top)
      if size == 0:
        explainer.null = explainer.refit(explainer.null)
      for item in sorted(grown, key=lambda g: -g.evidence)[: s.kept]:
        if item.terms != top.terms:
          explainer.refit(item, 3)
    grown = sorted(of_size(explainer.scored.values(), size + 1), key=lambda g: -g.evidence)
    asked = float(norm.isf(s.level)) if grown[0].is_strained(s.level) else s.worth
    better = grown[0].evidence > best.evidence and leaves(best)
    if clear(grown[0], best) < asked and not better:
      break
    best = grown[0]
    parents = [g for g in grown[: s.parents] if clear(best, g) < s.worth]
  for item in also:
    taken = explainer.take_over(item)
    if taken.evidence > best.evidence:
      best = explainer.adopt(taken)
  best = _exchanged(explainer, best, extended)
  for size in {len(item.names) for item in explainer.scored.values()}:
    same = of_size(explainer.scored.values(), size)
    if same:
      neutralise(explainer, max(same, key=lambda item: item.evidence))
  if leaves(best):
    beside_force(explainer, best)
  return explainer.ranked()


def _exchanged(explainer: Explainer, best: Scored, extended: set[tuple[Term, ...]]) -> Scored:
  """Returns a set of as many effects that is better, one of them in another's place, or the same.

  Effects that were added one by one were chosen where the others were missing yet (floating search,
  Pudil, Novovicova and Kittler 1994).

  Args:
    explainer: scores what has not been scored.
    best: the set.
    extended: hypotheses to which an effect has been added, of which all that lead are scored.
  """
  for _ in range(_EXCHANGES if len(best.names) > 1 else 0):
    begun = best
    for kind in sorted(begun.names):
      parent = lacking(explainer, begun, kind)
      if parent.terms in extended:
        continue
      extended.add(parent.terms)
      grown = explainer.extend(parent, explainer.settings.kept)
      top = max(grown, key=lambda g: g.evidence, default=best)
      if top.evidence > best.evidence:
        best = explainer.adopt(top)
    if best is begun:
      break
  return best
