"""What a joint has beyond its baseline: names by evidence that adds up, and a graded verdict.

The baseline is the declared model with its tolerances, or what reference logs show: constants, and
the effects that the machine has anyway. An effect is named where every tried hypothesis without it
is clearly worse (`naming`), and where the reference logs are clearly worse with it than without.
Where more remains, a name must also stand beside a force of any form.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.constancy import is_constant
from nerf2real.sysid.selection.joints.changed import CONSTANTS_OFF, Changed
from nerf2real.sysid.selection.joints.doubts import (
  constants_off,
  is_new,
  is_something,
  pressed,
  supported,
)
from nerf2real.sysid.selection.joints.leaving import is_unusual, leaves, may_leave, remaining
from nerf2real.sysid.selection.joints.naming import conclude
from nerf2real.sysid.selection.joints.subject import Subject, following
from nerf2real.sysid.selection.search.elaboration import elaborated
from nerf2real.sysid.selection.search.evidence import UNREPEATED, Scored, clear
from nerf2real.sysid.selection.search.growth import grow
from nerf2real.sysid.selection.search.rivals import with_anothers
from nerf2real.sysid.settings import SETTINGS, Settings

_REST = 0.1
"""Of the squares that all joints leave: less is left to joints that are not elaborated, chosen (5 %
of the error)."""

_AHEAD = 3  # rivals of an effect whose further effects are tried beside it, chosen


def explain(subject: Subject, settings: Settings = SETTINGS) -> Changed:
  """Explains what is new at a joint, beyond the effects of wider scope that it has.

  One with play is explained by a simulation that follows the readings.

  A course through play does not repeat, so that no model of it is near a whole log; what it
  predicts from each reading on is judged where play is in the best hypothesis of whole logs, or in
  the likeliest, which is seldom clear of the others there. Both are tried there, too: what makes
  all torques smaller hardly shows from one reading to the next, and whole logs find it beside play.
  What they name that the best hypothesis there holds as well is named by their evidence.
  """
  whole = _explained(subject, settings)
  done = subject.now.follows or whole.verdict in ("none", "effects")
  likely = max((s for s in whole.ranked if not s.neutral), key=lambda s: s.evidence)
  if done or not (whole.found.best.names | likely.names) & set(UNREPEATED):
    return whole
  also = {id(s): s for s in (whole.found.best, likely) if not s.beside_force}
  near = _explained(following(subject), settings, also=list(also.values()))
  stands = near.verdict == "effects" and set(near.named) & set(UNREPEATED)
  if not stands:
    return whole
  told = {n.kind: n for n in whole.found.names if n.kind in set(whole.named) - set(near.named)}
  if not told:
    return near
  names = tuple(told.get(n.kind, n) for n in near.found.names)
  named = tuple(n.kind for n in names if n.kind in (*near.named, *told))
  return dataclasses.replace(near, found=dataclasses.replace(near.found, names=names), named=named)


def _explained(subject: Subject, settings: Settings, also: Sequence[Scored] = ()) -> Changed:
  explainer = subject.explainer
  anyway, left = remaining(subject, explainer.null)
  more_at_first = bool(np.any(settings.more**2 * anyway < left))
  if may_leave(subject, explainer.null, settings) or more_at_first:
    ranked = grow(explainer, leaves=lambda item: leaves(subject, item, settings), also=also)
  else:
    ranked = explainer.constants_alone()
  return judged(subject, ranked, settings)


def judged(subject: Subject, ranked: list[Scored], settings: Settings) -> Changed:
  """Returns what of the ranked hypotheses stands."""
  now, before, usual = subject.now, subject.before, subject.usual
  known, explainer = subject.known, subject.explainer
  own = [t for t in known if t.names]
  as_it_was = now.residuals(own, np.concatenate([t.centre for t in own])[None])[0]
  baseline = now.squares(as_it_was)[0]
  found = conclude(now, ranked, subject.thresholds, baseline)
  ahead = [s for n in found.names for s in n.ahead[:_AHEAD]]
  if with_anothers(explainer, found.best, ahead):
    ranked = explainer.ranked()
    found = conclude(now, ranked, subject.thresholds, baseline)
  clearly = clear(found.best, explainer.null) > subject.beyond
  unusual = is_unusual(subject, explainer.null, settings)
  something = [k for k in sorted(found.best.names) if is_something(subject, found.best, k)]
  nameless = any(k not in something for k in found.named)  # clear, and maybe of no size
  if before is not None and usual is not None:
    something = [k for k in something if is_new(subject, found.best, k)]
  # What constants could take of an effect leaves its size open, and is not nothing for that.
  is_open = clearly and unusual and before is None
  lacking = is_open or (bool(something) and (clearly or unusual))
  named = () if pressed(found.best) else tuple(k for k in found.named if k in something)
  terms = {t.name: t for t in found.best.terms}
  growing = tuple(
    k for k in named if not is_constant([now], found.best.fit, terms[k], subject.beyond)
  )
  named = tuple(k for k in named if k not in growing)
  anyway, left = remaining(subject, found.best)
  typical, few = settings.more**2 * anyway < left
  if named and (typical or few or nameless):
    # That constants are off is no effect: beside it a misfit in few blocks needs no force.
    forced = [k for k in named if typical or nameless or k != CONSTANTS_OFF]
    named = supported(
      explainer, found.best, named, subject.beyond, anyway=float(anyway[1]), forced=forced
    )
    ranked = explainer.ranked()
  more = bool(typical or (few and any(k != CONSTANTS_OFF for k in named)))
  verdict = _verdict(
    lacking,
    named,
    any(t.wider for t in known),
    is_unusual(subject, found.best, settings),
    more,
  )
  off = constants_off(subject, found.best, settings)
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
    growing,
  )


def judge_together(found: Sequence[Changed], settings: Settings = SETTINGS) -> list[Changed]:
  """Returns findings whose names are judged at the level of all of the machine's together.

  One name by chance among many is no more of them than none among few: the level is that of so many
  joints as have a name (Benjamini and Hochberg 1995, from the clearest down), which is the same as
  before where nothing or one joint has any.
  """
  result, count = list(found), 1
  while (named := sum(any(k != CONSTANTS_OFF for k in c.named) for c in result)) > count:
    count = named
    for item in result:
      item.subject.sharing = len(result) / count
    result = [c if c.likelihood.follows else judged(c.subject, c.ranked, settings) for c in result]
  return result


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
      explainer, best = item.subject.explainer, item.found.best
      item.elaborated = elaborated(explainer, best, item.extended, item.named)


def _verdict(
  lacking: bool,
  named: Sequence[str],
  shared: bool,
  remains: bool,
  more: bool,
) -> str:
  """Returns the graded verdict of a joint.

  Args:
    lacking: whether the best hypothesis has a kind whose values are more than a machine's own, and
      that references do not have as well, and is clearly better than the baseline, or that leaves
      more than a healthy machine; without references both are enough where values are open. Names
      are tried from less on: what is not certain then is nothing.
    named: kinds that are certain.
    shared: whether the joint has effects of wider scope.
    remains: whether more is left than a healthy machine leaves.
    more: whether what is left beside names is beyond the limit.
  """
  if not named and not shared:
    return "unexplained" if remains or lacking else "none"
  if not named and not remains:
    return "none"
  return "partly" if more else "effects"
