"""Which effects of a joint are named: those that no hypothesis without them does as well as.

One rule, one level of significance: an effect of the best hypothesis is named where every tried
hypothesis without it is clearly worse (paired differences of left-out likelihood, `clearness`) than
the best one, or than itself with the effect beside or in the place of its own, at the family-wise
level of all effects tried; beside a clearer one, of all pairs of them, and so on:
among so many more is one sooner that fits what no hypothesis holds. Where a hypothesis without it
predicts the same motion, these logs cannot tell the two apart; both are said.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import norm

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.selection.search.evidence import Scored, clear, of_size, standardised
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray

USUAL = (
  *("command_delay", "coulomb_friction", "viscous_friction", "motor_gain", "encoder_offset"),
  *("gravity_tilt", "payload", "spring"),
)
"""Kinds in the order in which they are named where logs cannot tell them apart, chosen: a late
command is more usual than a late reading, a shifted zero than a machine that has been tilted, and
that a load, with its place, looks like a shifted zero would be a coincidence."""

SPECIAL = {"asymmetric_friction": "coulomb_friction"}
"""Kinds that have another as their special case: they are named where they are clear of it, else
the special case is, which hypotheses with the general kind do not lack."""


@dataclasses.dataclass(frozen=True)
class Name:
  """An effect of the best hypothesis."""

  kind: str
  clear: float
  """Standard errors by which hypotheses with it are better than any that lacks it."""
  certain: bool
  """Whether that is beyond the threshold, and no log is predicted clearly worse."""
  confounded: tuple[Scored, ...]
  """Hypotheses with another effect in its place that predict the same, the ones of fewest effects;
  one without any says that it is needless."""
  ahead: tuple[Scored, ...] = ()
  """Hypotheses with more effects that lack it and are not clearly worse, the likeliest first."""


@dataclasses.dataclass(frozen=True)
class Explanation:
  """What is concluded of one joint."""

  best: Scored
  names: tuple[Name, ...]
  share: float
  """Of the squared residual without effects that the names explain, on left-out blocks."""
  share_low: float
  """Lower end of that share's 95 % interval."""

  @property
  def named(self) -> tuple[str, ...]:
    """Kinds that are certain."""
    return tuple(n.kind for n in self.names if n.certain)


def thresholds(kinds: int, joints: float = 1, settings: Settings = SETTINGS) -> tuple[float, ...]:
  """Returns the standard errors that effects of a joint must be clear by, the clearest first.

  The n-th is found among all sets of n kinds (Bonferroni).

  Args:
    kinds: that are tried, at least as many as a joint may have.
    joints: that share the level, for each that has a name.
    settings: level, and the most effects of a joint.
  """
  sets = [math.comb(kinds, n + 1) for n in range(settings.depth)]
  return tuple(float(norm.isf(settings.level / max(n * joints, 1))) for n in sets)


def conclude(
  joint: JointLikelihood,
  ranked: Sequence[Scored],
  beyond: Sequence[float],
  without: Array | None = None,
) -> Explanation:
  """Returns the best hypothesis and what of it is certain.

  Args:
    joint: the logs.
    ranked: tried hypotheses, the one without effects among them.
    beyond: standard errors that count as clear, of one effect, of a second and so on.
    without: mean squares [B] that the baseline leaves as it was; those of the fitted one for None.
  """
  bare = best = max(of_size(ranked, 0), key=lambda s: s.evidence)
  for size in range(1, max(len(s.names) for s in ranked) + 1):
    # What is likelier and not clear of the best so far says nothing against one that is.
    for top in sorted(of_size(ranked, size), key=lambda s: -s.evidence):
      idle = [s for s in ranked if s.neutral and s.names < top.names]
      if all(clear(top, s) > _of_size(beyond, size) for s in (best, *idle)):
        best = top
        break
  last = _of_size(beyond, len(best.names))
  best = _usual(joint, best, ranked, last)
  names = _names(joint, best, ranked, beyond)
  for general, special in SPECIAL.items():
    if any(n.kind == general and not n.certain for n in names):
      simpler = [s for s in ranked if s.names == best.names - {general} | {special}]
      for item in sorted(simpler, key=lambda s: -s.evidence)[:1]:
        others = _names(joint, item, ranked, beyond)
        if _certain(others) >= _certain(names) | {special}:
          best, names = item, others
  share = _share(best.fit.held[0][0], bare.fit.held[0][0] if without is None else without)
  return Explanation(best, names, *share)


def _names(
  joint: JointLikelihood, best: Scored, ranked: Sequence[Scored], beyond: Sequence[float]
) -> tuple[Name, ...]:
  """Returns the effects of a hypothesis, and whether each is certain."""
  last = _of_size(beyond, len(best.names))
  names = [_name(joint, best, kind, ranked, last) for kind in sorted(best.names)]
  clearest = sorted(names, key=lambda n: -n.clear)
  certain = {n.kind for n, z in zip(clearest, beyond, strict=False) if n.certain and n.clear >= z}
  return tuple(dataclasses.replace(n, certain=n.kind in certain) for n in names)


def _of_size(beyond: Sequence[float], count: int) -> float:
  """Returns what counts as clear for so many effects: constants that are off may come on top of as
  many as are looked for."""
  return beyond[min(max(count, 1), len(beyond)) - 1]


def _certain(names: Sequence[Name]) -> set[str]:
  return {n.kind for n in names if n.certain}


def _usual(joint: JointLikelihood, best: Scored, ranked: Sequence[Scored], beyond: float) -> Scored:
  """Returns the most usual of the hypotheses that predict what the best one does and are as likely
  (of two there is one comparison, at the level itself), or are its special case and not clearly
  worse."""
  order = {kind: index for index, kind in enumerate(USUAL)}
  as_likely = float(norm.isf(joint.settings.level))
  special = {SPECIAL.get(kind, kind) for kind in best.names}
  alike = [
    s
    for s in of_size(ranked, len(best.names))
    if clear(best, s) < (beyond if s.names == special else as_likely) and _same(joint, best, s)
  ]
  return min([best, *alike], key=lambda s: sorted(order.get(k, len(order)) for k in s.names))


def _name(
  joint: JointLikelihood, best: Scored, kind: str, ranked: Sequence[Scored], beyond: float
) -> Name:
  forms = _forms(kind)
  rivals = [s for s in ranked if not forms & s.names and not s.beside_force]
  behind = [
    (max(clear(t, s) for t in (best, *_instead(s, kind, ranked), *_beside(s, kind, ranked))), s)
    for s in rivals
  ]
  near = [s for z, s in behind if z < beyond]
  alike = tuple(
    s
    for s in near
    if not s.names < best.names
    and (_same(joint, best, s) or any(_same(joint, s, t) for t in _instead(s, kind, ranked)))
  )
  alike = tuple(a for a in alike if not any(_holds(a, b) for b in alike))
  told = [z for z, s in behind if not any(s is a or _holds(s, a) for a in alike)]
  least = min(told, default=float("inf"))
  plain = max((s for s in rivals if s.names < best.names), key=lambda s: s.evidence)
  more = [s for s in near if len(s.names) > len(best.names)]
  more.sort(key=lambda s: -s.evidence)
  return Name(kind, least, carries_over(joint, best, plain), alike, tuple(more))


def _forms(kind: str) -> frozenset[str]:
  """Returns a kind and those that it is a special case of."""
  return frozenset([kind, *(general for general, special in SPECIAL.items() if special == kind)])


def _instead(rival: Scored, kind: str, ranked: Sequence[Scored]) -> list[Scored]:
  """Returns a rival's hypotheses with a kind, in any form, in the place of one of its own. One that
  predicts what the rival does is as good an explanation: what the rival is ahead by speaks not
  against the kind, but for what both have besides."""
  forms = [{form} for form in _forms(kind)]
  return [s for s in of_size(ranked, len(rival.names)) if s.names - rival.names in forms]


def _beside(rival: Scored, kind: str, ranked: Sequence[Scored]) -> list[Scored]:
  """Returns a rival's hypotheses with a kind, in any form, beside all of its own: where one is
  clearly better than the rival, so is what the rival explains no reason to do without the kind."""
  both = [rival.names | {form} for form in _forms(kind)]
  return [s for s in ranked if s.names in both and not s.neutral]


def _holds(item: Scored, twin: Scored) -> bool:
  """Tells whether a hypothesis is one that predicts the same as a name, with more effects."""
  return bool(twin.names) and twin.names < item.names


def carries_over(joint: JointLikelihood, item: Scored, plain: Scored) -> bool:
  """Tells whether a hypothesis predicts no log clearly worse than one without an effect.

  Logs are of different motions. Their blocks are predicted with values that were fitted to the
  other logs, so that an effect that holds has nothing to lose on any. Blocks share what the priors
  cost, as in `clearness`: constants that are strained do not pass for a hypothesis without.

  Args:
    joint: the logs.
    item: the hypothesis.
    plain: the same without an effect.
  """
  logs = np.unique(joint.log_of)
  least = float(norm.isf(joint.settings.level / len(logs)))
  gains = item.nats - plain.nats
  gains = gains - (item.prior - plain.prior) / len(gains)
  return all(standardised(gains[joint.log_of == log], least=1.0) > -least for log in logs)


def _same(joint: JointLikelihood, one: Scored, other: Scored) -> bool:
  return joint.alike(one.fit.residuals[0] - other.fit.residuals[0])


def _share(with_it: Array, without: Array, draws: int = 400) -> tuple[float, float]:
  """Returns the share of squares explained and the low end of its 95 % interval (bootstrap)."""
  random = np.random.default_rng(0)
  pick = random.integers(len(with_it), size=(draws, len(with_it)))
  drawn = 1.0 - with_it[pick].sum(axis=1) / np.maximum(without[pick].sum(axis=1), 1e-300)
  share = 1.0 - float(with_it.sum()) / max(float(without.sum()), 1e-300)
  return share, float(np.quantile(drawn, 0.025))
