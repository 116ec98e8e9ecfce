"""Reads a joint's ladder of evidence: nothing, constants off, named effects, or unexplained.

All thresholds are in nats of error (see `race`). They were set on healthy and faulty blind sets of
development seeds and of runs that were judged before; figures are reported of sets drawn later.
"""

import dataclasses
from typing import Any

import numpy as np

from nerf2real.sysid.selection import race
from nerf2real.sysid.selection.explanation import Ladder, is_even
from nerf2real.sysid.selection.race import Entry

_BELIEVED = 2  # effects of one joint that are claimed; more can imitate what no library has
_TIE = 0.03  # nats within which the usual kind is named rather than the rare one
_SIMPLER = 0.06
"""Nats within which fewer values are named rather than more: what three values cost by the Bayesian
information criterion (Schwarz 1978) with some 200 independent readings; ours."""
USUAL = (
  *("command_delay", "coulomb_friction", "viscous_friction", "motor_gain", "payload"),
  *("gravity_tilt", "encoder_offset", "spring"),
)
"""Kinds in the order in which they are named where logs cannot tell them apart; ours: a late
command is more usual than a late reading. Of a joint alone, a shifted zero is more usual than a
leaning mount, which several joints can tell from it."""
_FRICTION_SPREAD = 10.0  # dry friction varies that much more than other constants before it counts


@dataclasses.dataclass(frozen=True)
class Thresholds:
  """When a hypothesis is believed."""

  gain: float = 0.15
  """nats that an effect must gain over the calibrated model; healthy sets gained up to 0.04."""
  second: float = 0.2
  """nats that a second effect must gain over one."""
  margin: float = 0.12
  """nats within which a runner-up is as good: then the set is confounded."""
  adequate: float = 1.0
  """nats above the noise at which a hypothesis is not believed; healthy sets end up to 0.7."""
  adequate_log: float = 1.6
  """The same for the log that is explained least: what shows in slow motion only is an effect."""
  constant: float = 0.05
  """Relative error of a declared constant at which it is reported."""
  constants_gain: float = 0.3
  """nats that calibrated constants must gain over the declared ones."""


@dataclasses.dataclass(frozen=True)
class Finding:
  """What is concluded about one joint."""

  verdict: str
  """none, effects or unexplained."""
  chosen: Entry
  """The hypothesis that is put into the model."""
  named: bool
  """Whether the chosen hypothesis has effects beside the constants."""
  constants: bool
  """Whether the declared constants are off."""
  alternatives: list[Entry]
  """Other hypotheses, the best first, one a kind (or set of kinds)."""
  confounded: list[Entry]
  """Those that explain as much."""


def names(entry: Entry) -> frozenset[str]:
  """Returns the kinds of a hypothesis beside the constants."""
  return frozenset(t.kind for t in entry.fit.terms if t.kind != "calibration")


def unique(entries: list[Entry]) -> list[Entry]:
  """Returns the best entry of every set of kinds, in order."""
  seen: set[frozenset[str]] = set()
  result = []
  for entry in entries:
    if names(entry) not in seen:
      seen.add(names(entry))
      result.append(entry)
  return result


def usual_first(entries: list[Entry], *, alone: bool) -> list[Entry]:
  """Returns entries with the most usual of those that tie with the best one first.

  Args:
    entries: the best first; all of one number of kinds.
    alone: whether the machine has one joint.
  """
  best, most = entries[0].score, _values_that_show(entries[0])
  ties = [
    e for e in entries if e.score - best < (_SIMPLER if _values_that_show(e) < most else _TIE)
  ]
  order = {kind: index for index, kind in enumerate(USUAL)}
  if alone:
    order["gravity_tilt"] = len(order)
  fewest = min(_values_that_show(e) for e in ties)
  ties = [e for e in ties if _values_that_show(e) <= fewest + 1]
  first = min(ties, key=lambda e: sorted(order.get(k, len(order)) for k in names(e)))
  return [first, *[e for e in entries if e is not first]]


def _values_that_show(entry: Entry) -> int:
  """Returns how many values of a hypothesis logs can tell.

  Of a payload one joint shows its moment along two directions, and its inertia.
  """
  hidden = sum(len(t.names) - 3 for t in entry.fit.terms if t.kind == "payload")
  return len(entry.fit.x) - hidden


def without_even(entries: list[Entry], margin: float) -> list[Entry]:
  """Returns entries without asymmetric frictions that are even, where plain ones do as well.

  Args:
    entries: one of each set of kinds, the best first.
    margin: nats within which a plain dry friction does as well.
  """
  by_names = {names(e): e for e in entries}
  result = []
  for entry in entries:
    plain = by_names.get(names(entry) - {"asymmetric_friction"} | {"coulomb_friction"})
    if not is_even(entry) or plain is None or plain.score - entry.score > margin:
      result.append(entry)
  return result


def constants_off(entry: Entry, declared: Entry, null: Entry, thresholds: Thresholds) -> bool:
  """Tells whether the declared constants are off by more than machines of a kind differ."""
  values = entry.fit.values("calibration")
  factors = {n: v for n, v in values.items() if n not in ("skew", "latency")}
  limit = {n: thresholds.constant for n in factors}
  if "friction" in limit:
    limit["friction"] *= _FRICTION_SPREAD
  off = any(abs(v) > limit[n] for n, v in factors.items())
  return off and declared.score - null.score > thresholds.constants_gain


def adequate(entry: Entry, thresholds: Thresholds) -> bool:
  """Tells whether a hypothesis leaves no more than healthy joints do, over all logs and in each."""
  in_all = race.above_floor(entry) <= thresholds.adequate
  return in_all and race.worst_log(entry) <= thresholds.adequate_log


def decide(ladder: Ladder, thresholds: Thresholds | None = None) -> Finding:
  """Returns what is concluded about a joint."""
  thresholds = thresholds or Thresholds()
  singles = without_even(unique(ladder.singles), thresholds.margin)
  pairs = without_even(unique(ladder.pairs), thresholds.margin)
  alone = ladder.problem.plant.model.nu == 1
  singles = usual_first(singles, alone=alone)
  null = ladder.null
  best = singles[0]
  others = singles[1:]
  for size in sorted({len(names(e)) for e in pairs}):
    longer = usual_first([e for e in pairs if len(names(e)) == size], alone=alone)[0]
    if best.score - longer.score > thresholds.second:
      best, others = longer, [*(e for e in pairs if e is not longer), *singles]
  gained = null.score - best.score
  chosen = best if gained > thresholds.gain else null
  named = chosen is best
  constants = constants_off(chosen, ladder.declared, null, thresholds)
  confounded = [e for e in others if named and e.score - best.score < thresholds.margin]
  size = len(names(best))
  confounded = [e for e in confounded if len(names(e)) <= size]
  if not adequate(chosen, thresholds) or len(names(chosen)) > _BELIEVED:
    verdict = "unexplained"
  elif named or constants:
    verdict = "effects"
  else:
    verdict = "none"
  alternatives = sorted(others if named else [best, *others], key=lambda e: e.score)
  return Finding(verdict, chosen, named, constants, alternatives, confounded)


def unnamed(finding: Finding, ladder: Ladder, thresholds: Thresholds) -> Finding:
  """Returns a finding whose effects are not claimed: the constants are all that is in the model."""
  constants = constants_off(ladder.null, ladder.declared, ladder.null, thresholds)
  if not adequate(ladder.null, thresholds):
    verdict = "unexplained"
  else:
    verdict = "effects" if constants else "none"
  others = [finding.chosen, *finding.alternatives]
  return Finding(verdict, ladder.null, False, constants, others, [])


def evidence(entry: Entry, ladder: Ladder) -> dict[str, Any]:
  """Returns a hypothesis's evidence as numbers."""
  return {
    "gain_over_constants_nats": round(float(ladder.null.score - entry.score), 4),
    "gain_over_declared_nats": round(float(ladder.declared.score - entry.score), 4),
    "position_rms_in_noise": round(float(np.sqrt(np.mean(entry.levels[:, 0] ** 2))), 3),
    "position_rms_in_noise_by_log": [round(float(v), 2) for v in entry.levels[:, 0]],
    "state_follows_readings": ladder.problem.plant.follows,
  }
