"""What has changed since reference logs were recorded: names by evidence that adds up.

The reference logs give every joint a baseline: its constants, and the effects that it has anyway.
The logs to explain start from that baseline; what a further effect explains of them has changed.
An effect is named where every tried hypothesis without it is clearly worse (`naming`) and where the
reference logs are clearly worse with it than without.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.stats import norm

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.fitting import Fit as OldFit
from nerf2real.sysid.fit.fitting import Problem
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter, Layout
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.selection.baseline import freed_constants, known_terms
from nerf2real.sysid.selection.explain import Explainer, Scored, clear
from nerf2real.sysid.selection.naming import Explanation, conclude, threshold
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray


@dataclasses.dataclass
class Changed:
  """One joint: what it has anyway and what has changed."""

  joint: str
  likelihood: JointLikelihood
  problem: Problem
  explainer: Explainer
  known: tuple[Term, ...]
  """Constants and effects that the reference shows."""
  ranked: list[Scored]
  found: Explanation
  named: tuple[str, ...]
  """Kinds that are certain, and absent from the reference."""
  verdict: str
  """none, effects, partly or unexplained."""
  reference_left: float
  """What the machine leaves anyway in the median block, rad (m)."""
  left: float
  """The same of the logs, under the best hypothesis."""

  @property
  def null(self) -> Scored:
    """The baseline."""
    return self.explainer.null


def find(
  model: mujoco.MjModel,
  joint: str,
  logs: Sequence[Log],
  reference: Sequence[Log],
  *,
  reductions: tuple[Sequence[Reduction], Sequence[Reduction]],
  tried: int,
  settings: Settings = SETTINGS,
) -> Changed:
  """Explains what changed at a joint.

  Args:
    model: the declared one.
    joint: its name.
    logs: to explain.
    reference: of the same joint before.
    reductions: of the logs and of the reference.
    tried: joints that are looked at, over which the level of significance is shared.
    settings: tolerances and effort.
  """
  before = _likelihood(model, joint, reference, reductions[1], settings)
  own = constants(before.plant, settings)
  first = Explainer(before, own, _library(before.plant), settings=settings)
  beyond = threshold(len({t.kind for t in first.library}) * tried, settings)
  usual = conclude(before, first.explain(settings.reference_depth), beyond).best
  now = _likelihood(model, joint, logs, reductions[0], settings)
  return _compare(joint, now, before, usual, beyond, settings)


def _likelihood(
  model: mujoco.MjModel,
  joint: str,
  logs: Sequence[Log],
  reductions: Sequence[Reduction],
  settings: Settings,
) -> JointLikelihood:
  plant = JointModel(model, joint, logs, reductions=reductions, window_s=settings.window_s)
  return JointLikelihood(plant, settings=settings)


def _compare(
  joint: str,
  now: JointLikelihood,
  before: JointLikelihood,
  usual: Scored,
  beyond: float,
  settings: Settings,
) -> Changed:
  """Explains logs on top of what a reference's best hypothesis holds."""
  paired = now.expect(before, usual.fit.residuals[0])
  known = known_terms(usual, settings)
  explainer = Explainer(
    now,
    known[0],
    _library(now.plant),
    settings=settings,
    known=known[1:],
    freed=freed_constants(known[0], settings),
  )
  as_it_was = now.residuals(known, np.concatenate([t.centre for t in known])[None])[0]
  ranked = explainer.explain()
  found = conclude(now, ranked, beyond, now.squares(as_it_was)[0])
  named = tuple(k for k in found.named if paired or _is_new(before, usual, found.best, k, beyond))
  anyway = 2.0 * now.position_noise**2 if paired else float(np.median(usual.fit.held[0][0]))
  remains = _remains(now, found.best, before, usual, paired, beyond, settings)
  left = float(np.median(found.left))
  verdict = _verdict(found, named, remains, np.sqrt(left / max(anyway, 1e-300)), settings)
  return Changed(
    joint,
    now,
    Problem(now.plant),
    explainer,
    known,
    ranked,
    found,
    named,
    verdict,
    float(np.sqrt(anyway)),
    float(np.sqrt(left)),
  )


def _library(plant: JointModel) -> list[Term]:
  """Returns the effects to try; where torque repeats with position is read off the residual."""
  waves = signatures.waves(Problem(plant), OldFit((), np.zeros(0), 0.0, 1.0, 0))
  terms = [*candidates.library(plant), candidates.cogging(plant, waves)]
  return [plausible(term) for term in terms] if plant.hinge else terms


def _is_new(before: JointLikelihood, usual: Scored, best: Scored, kind: str, beyond: float) -> bool:
  """Tells whether the reference is clearly worse with an effect of these values than without."""
  term = next(t for t in best.terms if t.name == kind)
  if term.freed:
    return True
  held = term.held_at(np.array(list(best.fit.values(term).values())))
  kept = [(t, usual.fit.values(t)) for t in usual.terms if t.kind != kind]
  terms = (*[t for t, _ in kept], held)
  x = np.array([v for _, values in kept for v in values.values()])
  fitter = Fitter([before], Layout([terms]))
  fit = fitter.leave_out(fitter.fit(x, iterations=3))
  return clear(usual, Scored(terms, fit, before.loglik(fit.held[0]))) > beyond


def _remains(
  now: JointLikelihood,
  best: Scored,
  before: JointLikelihood,
  usual: Scored,
  paired: bool,
  beyond: float,
  settings: Settings,
) -> bool:
  """Tells whether more remains than the machine leaves anyway.

  Beside a reference with the same commands only noise may remain: neighbouring readings' residuals
  must not go together, but in one block (which may hold a knock). Else blocks are compared with
  the reference's, on a logarithmic scale.
  """
  if paired:
    certain, size = _together(now, best.fit.residuals[0][0])
    # Two of B blocks exceed z by chance with a probability of (B p)^2 / 2 at most.
    rare = float(norm.isf(np.sqrt(2.0 * settings.level) / len(certain)))
    large = size > (settings.structured * now.position_noise) ** 2
    return int(np.sum((certain > rare) & large)) >= 2
  mine, usually = (0.5 * np.log(s.fit.held[0][0] + 1e-30) for s in (best, usual))
  error = np.sqrt(np.var(mine) / len(mine) + np.var(usually) / len(usually))
  ratio = float(mine.mean() - usually.mean())
  return ratio > beyond * error or ratio > float(np.log(settings.more))


def _together(joint: JointLikelihood, residual: Array) -> tuple[Array, Array]:
  """Returns how surely neighbouring readings' residuals go together in a block, and how much [B].

  Sum of products over its standard error under independence, and the mean product.
  """
  products = np.append(residual[1:] * residual[:-1], 0.0)
  total = np.add.reduceat(products, joint.starts)
  error = np.sqrt(np.add.reduceat(products**2, joint.starts))
  return total / np.maximum(error, 1e-300), total / joint.counts[0]


def _verdict(
  found: Explanation, named: Sequence[str], remains: bool, over: float, settings: Settings
) -> str:
  """Returns the graded verdict of a joint.

  Args:
    found: the best hypothesis.
    named: kinds that are certain.
    remains: whether more remains than the machine leaves anyway.
    over: what the median block leaves, over what the machine leaves anyway.
    settings: limits.
  """
  if not named:
    return "unexplained" if remains or found.best.names else "none"
  if over <= settings.more:
    return "effects"
  return "partly" if found.share_low > settings.most else "unexplained"
