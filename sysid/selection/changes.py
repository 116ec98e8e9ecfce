"""What has changed since reference logs were recorded: names by evidence that adds up.

The reference logs give every joint a baseline: its constants, and the effects that it has anyway.
The logs to explain start from that baseline; what a further effect explains of them has changed.
An effect is named where every tried hypothesis without it is clearly worse (`naming`) and where the
reference logs are clearly worse with it than without.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.fitting import Fit as JointFit
from nerf2real.sysid.fit.fitting import Problem
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter, Layout
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.explain import Scored, clear
from nerf2real.sysid.selection.naming import Explanation, conclude
from nerf2real.sysid.selection.remainder import grown, structured
from nerf2real.sysid.selection.subject import Subject
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray


@dataclasses.dataclass
class Changed:
  """What is new at a joint."""

  subject: Subject
  problem: Problem
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
  def extended(self) -> Scored:
    """The hypothesis to simulate with: where more remains, what predicts left-out blocks best."""
    if self.verdict not in ("partly", "unexplained"):
      return self.found.best
    fitting = [s for s in self.ranked if not s.neutral and s.names >= set(self.named)]
    return max(fitting, key=lambda s: s.evidence, default=self.found.best)

  @property
  def joint(self) -> str:
    """Its name."""
    return self.subject.joint

  @property
  def known(self) -> tuple[Term, ...]:
    """Constants and effects that were known before."""
    return self.subject.known

  @property
  def null(self) -> Scored:
    """The baseline."""
    return self.subject.explainer.null


def explain(subject: Subject, settings: Settings = SETTINGS) -> Changed:
  """Explains what is new at a joint, beyond the effects of wider scope that it has."""
  now, before, usual = subject.now, subject.before, subject.usual
  known, explainer = subject.known, subject.explainer
  own = [t for t in known if t.names]
  as_it_was = now.residuals(own, np.concatenate([t.centre for t in own])[None])[0]
  if subject.alone or leaves(subject, explainer.null, settings):
    ranked = explainer.explain(leaves=lambda item: leaves(subject, item, settings))
  else:
    ranked = explainer.constants_alone()
  found = conclude(now, ranked, subject.beyond, now.squares(as_it_was)[0])
  problem = Problem(now.plant)
  named = tuple(k for k in found.named if _is_something(problem, found.best, k))
  if before is not None and usual is not None and not subject.paired:
    named = tuple(k for k in named if _is_new(before, usual, found.best, k, subject.beyond))
  anyway = (2.0 if subject.paired else 1.0) * now.position_noise**2
  if usual is not None and not subject.paired:
    anyway = float(np.median(usual.fit.held[0][0]))
  left = float(np.median(found.left))
  over = float(np.sqrt(left / max(anyway, 1e-300)))
  return Changed(
    subject,
    problem,
    ranked,
    found,
    named,
    _verdict(
      found, named, len(own) < len(known), leaves(subject, found.best, settings), over, settings
    ),
    float(np.sqrt(anyway)),
    float(np.sqrt(left)),
  )


def leaves(subject: Subject, item: Scored, settings: Settings) -> bool:
  """Tells whether a hypothesis leaves more than the machine does anyway.

  Beside a reference with the same commands only noise may remain; beside another its blocks are the
  measure; without one, a multiple of the readings' noise.
  """
  if subject.paired:
    return structured(subject.now, item, settings)
  if subject.usual is not None:
    return grown(item, subject.usual, subject.beyond, settings)
  left = float(np.sqrt(np.median(item.fit.held[0][0])))
  return left > settings.more * subject.now.position_noise


def _is_something(problem: Problem, best: Scored, kind: str) -> bool:
  """Tells whether an effect's values differ from those that do nothing, by their intervals.

  Of effects that have sizes only: where a shape is fitted, too, a size may be open that is surely
  not nothing, as a payload's mass is where its moment is sure.
  """
  term = next(t for t in best.terms if t.name == kind)
  sizes = {} if term.freed else {p.name: p for p in kind_of(kind).parameters if not p.shape}
  if not term.names or any(n not in sizes for n in term.names):
    return True
  fit = JointFit(best.terms, best.fit.x, best.fit.cost, 1.0, 0)
  bounds = intervals.intervals(problem, fit, kind)
  return any(not low <= sizes[n].nominal <= high for n, (low, high) in bounds.items())


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


def _verdict(
  found: Explanation,
  named: Sequence[str],
  shared: bool,
  remains: bool,
  over: float,
  settings: Settings,
) -> str:
  """Returns the graded verdict of a joint.

  Args:
    found: the best hypothesis.
    named: kinds that are certain.
    shared: whether the joint has effects of wider scope.
    remains: whether more remains than the machine leaves anyway.
    over: what the median block leaves, over what the machine leaves anyway.
    settings: limits.
  """
  if not named and not shared:
    return "unexplained" if remains or found.best.names else "none"
  if not named and not remains:
    return "none"
  if over <= settings.more:
    return "effects"
  return "partly" if found.share_low > settings.most else "unexplained"
