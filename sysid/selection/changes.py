"""What a joint has beyond its baseline: names by evidence that adds up, and a graded verdict.

The baseline is the declared model with its tolerances, or what reference logs show: constants, and
the effects that the machine has anyway. An effect is named where every tried hypothesis without it
is clearly worse (`naming`), and where the reference logs are clearly worse with it than without.
Where more remains, a name must also stand beside a force of any form.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CLOCKS, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.constants import OWN
from nerf2real.sysid.hypotheses.free_force import VARIABLE
from nerf2real.sysid.selection.changed import Changed
from nerf2real.sysid.selection.judging.evidence import UNREPEATED, Scored, clear, more_likely
from nerf2real.sysid.selection.judging.naming import Explanation, conclude
from nerf2real.sysid.selection.judging.remainder import grown, mean_left, scatter, structured
from nerf2real.sysid.selection.search import rivals
from nerf2real.sysid.selection.search.elaboration import elaborated
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.selection.search.growth import grow
from nerf2real.sysid.selection.subject import Subject, following
from nerf2real.sysid.settings import SETTINGS, Settings

Array = np.ndarray


CONSTANTS_OFF = "parameter_error"
_MOMENTS = ("payload",)
"""Kinds of which a product of values shows: the product is sure where none of them is."""
_REST = 0.1
"""Of the squares that all joints leave: less is left to joints that are not elaborated, chosen (5 %
of the error)."""


def explain(subject: Subject, settings: Settings = SETTINGS) -> Changed:
  """Explains what is new at a joint, beyond the effects of wider scope that it has.

  One with play is explained by a simulation that follows the readings.

  A course through play does not repeat, so that no model of it is near a whole log; what it
  predicts from each reading on is judged where play is in the best hypothesis of whole logs.
  """
  whole = _explained(subject, settings)
  done = subject.now.follows or whole.verdict in ("none", "effects")
  if done or not whole.found.best.names & set(UNREPEATED):
    return whole
  near = _explained(following(subject), settings)
  stands = near.verdict == "effects" and set(near.named) & set(UNREPEATED)
  return near if stands else whole


def _explained(subject: Subject, settings: Settings) -> Changed:
  now, before, usual = subject.now, subject.before, subject.usual
  known, explainer = subject.known, subject.explainer
  own = [t for t in known if t.names]
  as_it_was = now.residuals(own, np.concatenate([t.centre for t in own])[None])[0]
  anyway, left = _remaining(subject, explainer.null)
  if _may_leave(subject, explainer.null, settings) or np.any(settings.more**2 * anyway < left):
    ranked = grow(explainer, leaves=lambda item: leaves(subject, item, settings))
  else:
    ranked = explainer.constants_alone()
  found = conclude(now, ranked, subject.beyond, now.squares(as_it_was)[0])
  named = tuple(k for k in found.named if _is_something(subject, found.best, k))
  if before is not None and usual is not None and not subject.paired:
    named = tuple(k for k in named if _is_new(before, usual, found.best, k))
  anyway, left = _remaining(subject, found.best)
  typical, few = settings.more**2 * anyway < left
  if named and (typical or few):
    # That constants are off is no effect: beside it a misfit in few blocks needs no force.
    forced = [k for k in named if typical or k != CONSTANTS_OFF]
    named = _supported(
      explainer, found.best, named, subject.beyond, anyway=float(anyway[1]), forced=forced
    )
    ranked = explainer.ranked()
  more = bool(typical or (few and any(k != CONSTANTS_OFF for k in named)))
  verdict = _verdict(
    found,
    named,
    any(t.wider for t in known),
    bool(typical or (few and before is not None)) or leaves(subject, found.best, settings),
    more,
  )
  off = _constants_off(subject, found.best, settings)
  return Changed(
    subject,
    ranked,
    found,
    named,
    "effects" if off and verdict == "none" else verdict,
    float(np.sqrt(anyway[1])),
    float(np.sqrt(left[1])),
    more,
    off,
  )


def _remaining(subject: Subject, item: Scored) -> tuple[Array, Array]:
  """Returns what a machine leaves anyway, and what a hypothesis does: mean squares [2] of
  the median block, and of all blocks by `mean_left`."""
  now, before, usual = subject.now, subject.before, subject.usual

  def both(joint: JointLikelihood, squares: Array) -> Array:
    return np.array([np.median(squares), mean_left(joint, squares)])

  anyway = np.full(2, (2.0 if subject.paired else 1.0) * now.position_noise**2)
  if before is not None and usual is not None and not subject.paired:
    anyway = both(before, usual.fit.held[0][0])
  if now.follows:
    anyway = np.maximum(anyway, both(now, scatter(now, item)))
  return anyway, both(now, item.fit.held[0][0])


def elaborate(found: Sequence[Changed]) -> None:
  """Adds fits with richer friction where more remains than names explain.

  They make predictions better by what is left. Joints come in the order of that, until all others
  together leave no more than a tenth of the squares.
  """
  left = sorted(found, key=lambda c: -c.left)
  most = np.cumsum([c.left**2 for c in left])
  before = np.append(0.0, most[:-1])
  for item, sum_before in zip(left, before, strict=True):
    if sum_before > (1.0 - _REST) * most[-1]:
      break
    if item.verdict in ("partly", "unexplained") and not item.likelihood.follows:
      item.elaborated = elaborated(item.subject.explainer, item.found.best, item.named)


def _constants_off(subject: Subject, best: Scored, settings: Settings) -> bool:
  """Tells whether a declared constant is off by more than its tolerance, all of its interval.

  Beside a reference the constants are those that it shows.
  """
  term = best.terms[0]
  if subject.before is not None or term.freed:
    return False
  tolerance = dict(settings.tolerances)
  bounds = intervals.intervals(subject.now, best.fit, term, own_latency=True)
  shares = [n for n in term.names if n not in (*CLOCKS, "zero")]
  return any(bounds[n][0] > tolerance[n] or bounds[n][1] < -tolerance[n] for n in shares)


def _supported(
  explainer: Explainer,
  best: Scored,
  named: Sequence[str],
  beyond: float,
  *,
  anyway: float,
  forced: Sequence[str],
) -> tuple[str, ...]:
  """Returns the names that stand where something is left that no name is for.

  What is named may then be a part of that: half of a soft stop is a spring. A kind must explain
  more squares than remain. One that is a force over one variable stands unless a force of any form
  over that variable does clearly better; any other where hypotheses with a force of any form over
  both are clearly worse without it.

  Args:
    explainer: scores what has not been scored.
    best: the best hypothesis, of which more remains than the machine leaves anyway.
    named: kinds that are clear.
    beyond: standard errors that count as clear.
    anyway: mean square that the machine leaves anyway.
    forced: kinds that are tried beside a force.
  """
  kept = []
  left = mean_left(explainer.joint, best.fit.held[0][0])
  for kind in named:
    without = rivals.lacking(explainer, best, kind)
    explained = mean_left(explainer.joint, without.fit.held[0][0]) - left
    if explained <= left - anyway or kind not in forced:
      stands = explained > left - anyway
    elif kind in VARIABLE:
      rival = rivals.with_force(explainer, without, VARIABLE[kind])
      stands = clear(rival, best) <= beyond
    else:
      both = (rivals.with_force(explainer, s) for s in (best, without))
      stands = clear(*both) > beyond
    if stands:
      kept.append(kind)
  return tuple(kept)


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


def _may_leave(subject: Subject, item: Scored, settings: Settings) -> bool:
  """Tells whether a hypothesis may leave more than the machine does anyway: effects are tried then,
  and names must be clear by themselves."""
  if subject.usual is not None and not subject.paired:
    return grown(item, subject.usual, settings.suspected, settings)
  return leaves(subject, item, settings)


def _is_something(subject: Subject, best: Scored, kind: str) -> bool:
  """Tells whether an effect's sizes differ from those that do nothing, by their intervals.

  What healthy machines have of an effect is nothing, too, where no reference shows it. A payload's
  mass may be open where its moment is sure.
  """
  term = next(t for t in best.terms if t.name == kind)
  if term.freed or not term.names or kind in _MOMENTS:
    return True
  alone = subject.before is None
  sizes = {p.name: p.nominal for p in kind_of(kind).parameters if not p.shape}
  own = OWN.get(kind, {}) if alone and subject.now.plant.hinge else {}
  bounds = intervals.intervals(subject.now, best.fit, term, own_latency=alone)
  return any(
    not low - own.get(n, 0.0) <= sizes[n] <= high for n, (low, high) in bounds.items() if n in sizes
  )


def _is_new(before: JointLikelihood, usual: Scored, best: Scored, kind: str) -> bool:
  """Tells whether the reference is less likely with an effect of these values than without."""
  term = next(t for t in best.terms if t.name == kind)
  if term.freed:
    return True
  held = term.held_at(np.array(list(best.fit.values(term).values())))
  kept = [(t, usual.fit.values(t)) for t in usual.terms if t.kind != kind]
  terms = (*[t for t, _ in kept], held)
  x = np.array([v for _, values in kept for v in values.values()])
  fitter = Fitter([before], Layout([terms]))
  fit = fitter.leave_out(fitter.fit(x, iterations=3))
  beside = Scored(terms, fit, before.loglik(fit.held[0]))
  gains, prior = usual.nats - beside.nats, usual.prior - beside.prior
  return more_likely(gains, prior, before.settings.level)


def _verdict(
  found: Explanation,
  named: Sequence[str],
  shared: bool,
  remains: bool,
  more: bool,
) -> str:
  """Returns the graded verdict of a joint.

  Args:
    found: the best hypothesis.
    named: kinds that are certain.
    shared: whether the joint has effects of wider scope.
    remains: whether more is left than the machine leaves anyway, by a test or by that limit.
    more: whether it is by the limit.
  """
  if not named and not shared:
    return "unexplained" if remains or found.best.names else "none"
  if not named and not remains:
    return "none"
  return "partly" if more else "effects"
