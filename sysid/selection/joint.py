"""One joint's case: its race, what is concluded of it, and the final fit of what was chosen."""

import dataclasses

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.selection import decision, detection, elaboration, explanation, race
from nerf2real.sysid.selection.decision import Finding, Thresholds
from nerf2real.sysid.selection.explanation import Effort, Ladder
from nerf2real.sysid.selection.race import CLOCKS, Entry
from nerf2real.sysid.selection.screening import Screened

_RELATIVE = {"friction": 2.5, "gain": 0.3}
"""Spread of a constant over that of the others, as `candidates.calibration` has it."""

_PLAY = "backlash"
_NEARER = 0.6
"""Of what else must be gained, where a simulation follows the readings: all is nearer to the noise
then. Ours, on blind sets of development seeds and of runs that were judged before."""
_PARENTS = 2  # single effects on which a second is raced, where play is one of the two; ours

_NO_LATENCY = 2e-4
"""s; spread of latencies beside a delay, from which they cannot be told."""


@dataclasses.dataclass
class Found:
  """One raced joint."""

  screened: Screened
  ladder: Ladder
  finding: Finding
  chance: dict[str, float]
  thresholds: Thresholds
  """This joint's."""

  @property
  def joint(self) -> str:
    """Its name."""
    return self.screened.joint


def race_joint(screened: Screened, thresholds: Thresholds, effort: Effort, *, seed: int) -> Found:
  """Races all candidates on a joint and decides; what chance gains raises the threshold."""
  ladder = explanation.alone(
    screened.problem, screened.calibration, screened.declared, screened.null, effort=effort
  )
  suspected = _leads(ladder, thresholds)
  if suspected and (found := _with_play(screened, thresholds, effort, seed=seed)):
    return found
  ladder = explanation.together(ladder, effort=effort)
  found = _decided(screened, ladder, thresholds, seed=seed)
  if _PLAY in decision.names(ladder.best()) and not suspected:
    return _with_play(screened, thresholds, effort, seed=seed) or found
  return found


def _decided(screened: Screened, ladder: Ladder, thresholds: Thresholds, *, seed: int) -> Found:
  """Returns what a ladder says of a joint."""
  chance = detection.chance_gain(ladder.problem, ladder.null, ladder.singles[:12], seed=seed)
  own = dataclasses.replace(thresholds, gain=max(thresholds.gain, 2.0 * chance["q95"]))
  return Found(screened, ladder, decide(ladder, own), chance, own)


def decide(ladder: Ladder, thresholds: Thresholds) -> Finding:
  """Returns what is concluded of a ladder; what is named also gains on blocks that were left out.

  Args:
    ladder: the evidence.
    thresholds: this joint's.
  """
  finding = decision.decide(ladder, thresholds)
  if finding.named and gain_on_left_out(ladder, finding.chosen) < thresholds.gain:
    return decision.unnamed(finding, ladder, thresholds)
  return finding


def _leads(ladder: Ladder, thresholds: Thresholds) -> bool:
  """Tells whether play explains more than any other single effect by the usual margin."""
  first, *others = decision.unique(ladder.singles)
  clear = all(e.score - first.score > thresholds.margin for e in others)
  gained = ladder.null.score - first.score
  return decision.names(first) == {_PLAY} and clear and gained > thresholds.gain


def _with_play(
  screened: Screened, thresholds: Thresholds, effort: Effort, *, seed: int
) -> Found | None:
  """Judges a joint by a simulation that follows the readings; None if it does not find play.

  A course through play does not repeat, so over a whole log no model of it is adequate, and the gap
  is fitted too small.
  """
  problem = screened.problem.following()
  calibration, declared, null = explanation.bare(problem, screened.calibration)
  effort = dataclasses.replace(effort, parents=_PARENTS)
  thresholds = dataclasses.replace(
    thresholds,
    gain=_NEARER * thresholds.gain,
    second=_NEARER * thresholds.second,
    margin=_NEARER * thresholds.margin,
  )
  ladder = explanation.climb(problem, calibration, declared, null, effort=effort)
  found = _decided(screened, ladder, thresholds, seed=seed)
  chosen = found.finding.chosen
  if found.finding.verdict != "effects" or _PLAY not in decision.names(chosen):
    return None
  if _PLAY in may_be_nothing(ladder, chosen):
    return None
  count = len(decision.names(chosen))
  rivals = [e for e in [*ladder.singles, *ladder.pairs] if len(decision.names(e)) <= count]
  without = [e for e in rivals if _PLAY not in decision.names(e)]
  return found if all(e.score - chosen.score > thresholds.margin for e in without) else None


def gain_on_left_out(ladder: Ladder, entry: Entry) -> float:
  """Returns what a hypothesis gains over the constants alone on left-out blocks, nats."""
  null, chosen = (race.held_out(ladder.problem, e) for e in (ladder.null, entry))
  return null.score - chosen.score


def polished(item: Found, spread: float) -> Entry:
  """Fits the chosen hypothesis to the end, constants held as near to declared as their like."""
  entry = item.finding.chosen
  terms = list(entry.fit.terms)
  prior = dict(zip(terms[0].names, terms[0].prior, strict=True))
  if not terms[0].centre:  # neither reference logs nor other joints tell
    prior = {n: p if n in CLOCKS else _RELATIVE.get(n, 1.0) * spread for n, p in prior.items()}
  if {"command_delay", "measurement_delay"} & decision.names(entry):
    # A delay takes in what latency there is beside it.
    prior = {n: min(p, _NO_LATENCY) if n in CLOCKS else p for n, p in prior.items()}
  terms[0] = dataclasses.replace(terms[0], prior=tuple(prior.values()))
  problem = item.ladder.problem
  if _PLAY in decision.names(entry) and not problem.plant.follows:
    problem = problem.following()
  as_declared = entry.fit.x.copy()
  as_declared[: len(terms[0].names)] = terms[0].starts[0]
  fits = [problem.fit(terms, x, evaluations=40) for x in (entry.fit.x, as_declared)]
  return race.entry(item.ladder.problem, min(fits, key=lambda f: f.cost))


def may_be_nothing(ladder: Ladder, entry: Entry) -> frozenset[str]:
  """Returns the kinds of a hypothesis whose size may be what does nothing, by its interval.

  Asked are kinds of one size (of play its gap): a payload's mass may be open where its moment is
  sure.
  """
  result = set()
  for term in entry.fit.terms[1:]:
    size = term.names[0]
    if len(term.names) == 1 or term.kind == _PLAY:
      low, high = intervals.intervals(ladder.problem, entry.fit, term.kind)[size]
      if low <= kind_of(term.kind).parameter(size).nominal <= high:
        result.add(term.kind)
  return frozenset(result)


def without_nothing(item: Found, spread: float) -> Entry:
  """Returns the chosen hypothesis fitted to the end; effects that may be nothing are not named."""
  entry = polished(item, spread)
  nothing = may_be_nothing(item.ladder, entry)
  if not nothing:
    return entry
  left = decision.names(entry) - nothing
  others = [e for e in [*item.ladder.singles, *item.ladder.pairs] if decision.names(e) == left]
  if left and others and _stands(item, others[0]):
    item.finding = dataclasses.replace(item.finding, chosen=others[0])
    return polished(item, spread)
  item.finding = decision.unnamed(item.finding, item.ladder, item.thresholds)
  return item.finding.chosen


def _stands(item: Found, entry: Entry) -> bool:
  """Tells whether a hypothesis explains a joint and gains on left-out blocks, as names must."""
  enough = gain_on_left_out(item.ladder, entry) >= item.thresholds.gain
  return enough and decision.adequate(entry, item.thresholds)


def look_again(item: Found) -> bool:
  """Fits richer friction where a joint stays unexplained, and what led to it by itself.

  A hypothesis that a race gave up too early may be enough once it is fitted to the end: then it is
  decided anew. Richer friction goes into the model and is no ground for a name.

  Returns:
    Whether the model takes richer friction; it is fitted to the end.
  """
  problem, ladder = item.screened.problem, item.ladder
  richer = elaboration.elaborate(ladder, item.finding.chosen)
  if richer is item.finding.chosen:
    return False
  *terms, last = richer.fit.terms
  x = richer.fit.x[: len(richer.fit.x) - len(last.names)]
  plain = race.entry(problem, problem.fit(terms, x, evaluations=60))
  if decision.names(plain):
    entries = ladder.singles if len(decision.names(plain)) == 1 else ladder.pairs
    entries.append(plain)
    entries.sort(key=lambda e: e.score)
    again = decide(ladder, item.thresholds)
    if again.verdict == "effects":
      item.finding = again
      return False
  item.finding = dataclasses.replace(item.finding, chosen=richer, named=True)
  return True
