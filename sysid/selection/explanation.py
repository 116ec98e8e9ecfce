"""Explains one joint: the calibrated null model, single effects, pairs; each with its evidence.

Nothing is decided here; `decision` reads the ladder.
"""

import dataclasses

import numpy as np

from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.fitting import Problem
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.selection import race
from nerf2real.sysid.selection.race import Entry

_LOPSIDED = 0.15  # difference over sum of an asymmetric friction from which it is called that
_STEP = 0.2  # nats that a chain's next effect must gain; as decision.Thresholds.second


@dataclasses.dataclass(frozen=True)
class Effort:
  """How much is computed."""

  finalists: int = 6
  """Candidates of a race that are fitted to the end."""
  parents: int = 6
  """Single effects on top of which a second one is raced; one of a pair alone may rank low."""
  parent_margin: float = 1.5
  """nats; single effects further behind are no parents."""
  longest: int = 4
  """Effects in a chain that is grown where two leave much; three or more are used, not claimed."""
  growing: float = 0.9
  """nats above the noise at which a chain grows further."""
  adequate: float = 0.35
  """nats above the noise floor at which a hypothesis leaves nothing for a second effect."""


@dataclasses.dataclass
class Ladder:
  """The evidence about one joint, from the declared model upwards. Scores are in nats of error."""

  problem: Problem
  calibration: Term
  declared: Entry
  null: Entry
  singles: list[Entry]
  pairs: list[Entry]
  """Two effects, or longer chains."""

  def best(self) -> Entry:
    """The hypothesis of the lowest score."""
    return min([self.null, *self.singles, *self.pairs], key=lambda e: e.score)


def bare(problem: Problem, calibration: Term | None = None) -> tuple[Term, Entry, Entry]:
  """Returns the calibration term, and the declared and the calibrated model's entries."""
  term = candidates.calibration(problem.plant) if calibration is None else calibration
  declared = race.entry(problem, problem.fit([]))
  null = race.entry(problem, problem.fit([term]))
  return term, declared, null


def kinds_for(problem: Problem, null: Entry) -> list[Term]:
  """Returns the candidates for a joint, with those whose starts need its residual."""
  plant = problem.plant
  return [
    *candidates.library(plant),
    candidates.cogging(plant, signatures.waves(problem, null.fit)),
  ]


def alone(
  problem: Problem, calibration: Term, declared: Entry, null: Entry, *, effort: Effort
) -> Ladder:
  """Races single effects."""
  library = kinds_for(problem, null)
  start = null.fit.x
  singles = race.run(problem, [calibration], library, start=start, finalists=effort.finalists)
  return Ladder(problem, calibration, declared, null, singles, [])


def climb(
  problem: Problem, calibration: Term, declared: Entry, null: Entry, *, effort: Effort | None = None
) -> Ladder:
  """Races single effects, then pairs where the best single one leaves something."""
  effort = effort or Effort()
  return together(alone(problem, calibration, declared, null, effort=effort), effort=effort)


def together(ladder: Ladder, *, effort: Effort) -> Ladder:
  """Races pairs and longer chains where the best single effect leaves something; returns them."""
  singles = ladder.singles
  if race.above_floor(singles[0]) > effort.adequate:
    ladder.pairs = pairs(ladder, effort=effort)
    grow(ladder, effort=effort)
    prune(ladder)
    even_out(ladder)
  return ladder


def beside(problem: Problem, hypothesis: Entry) -> list[Term]:
  """Returns the candidates for one more effect beside those of a hypothesis."""
  plant = problem.plant
  waves = signatures.waves(problem, hypothesis.fit)
  present = {t.kind for t in hypothesis.fit.terms} | _doubles(plant)
  library = [*candidates.library(plant), candidates.cogging(plant, waves)]
  return [c for c in library if c.kind not in present]


def _doubles(plant: JointPlant) -> set[str]:
  """Returns kinds that a joint's logs cannot tell from another one: raced alone only.

  Of a machine with one joint a leaning mount is a shifted zero.
  """
  return {"gravity_tilt"} if plant.holds and plant.model.nu == 1 else set()


def grow(ladder: Ladder, *, effort: Effort) -> None:
  """Adds effects to the best pair one by one while they help and much is left."""
  problem = ladder.problem
  for size in range(3, effort.longest + 1):
    best = ladder.best()
    if race.above_floor(best) < effort.growing or len(best.fit.terms) != size:
      return
    others = beside(problem, best)
    found = race.run(problem, best.fit.terms, others, start=best.fit.x, finalists=2)
    if best.score - found[0].score < _STEP:
      return
    ladder.pairs = sorted([*ladder.pairs, *found[:3]], key=lambda e: e.score)


def prune(ladder: Ladder) -> None:
  """Takes out of the best hypothesis, one by one, the effects that it does without.

  An effect that explained something alone may be idle once others stand beside it.
  """
  best = ladder.best()
  while len(best.fit.terms) > 2:
    shorter = min(
      (_without(ladder.problem, best, i) for i in range(1, len(best.fit.terms))),
      key=lambda e: e.score,
    )
    if shorter.score - best.score > _STEP:
      return
    entries = ladder.singles if len(shorter.fit.terms) == 2 else ladder.pairs
    entries.append(shorter)
    entries.sort(key=lambda e: e.score)
    best = shorter


def is_even(entry: Entry) -> bool:
  """Tells whether a hypothesis has an asymmetric friction that is the same both ways."""
  sides = list(entry.fit.values("asymmetric_friction").values())
  return bool(sides) and abs(sides[0] - sides[1]) < _LOPSIDED * sum(sides)


def even_out(ladder: Ladder) -> None:
  """Adds plain dry frictions for asymmetric ones that are even, in the best hypotheses."""
  problem = ladder.problem
  (plain,) = (t for t in candidates.library(problem.plant) if t.kind == "coulomb_friction")
  best: dict[int, Entry] = {}
  for entry in [*ladder.singles, *ladder.pairs]:
    known = best.setdefault(len(entry.fit.terms), entry)
    best[len(entry.fit.terms)] = min(known, entry, key=lambda e: e.score)
  for count, entry in best.items():
    if not is_even(entry):
      continue
    at = [t.kind for t in entry.fit.terms].index("asymmetric_friction")
    terms, parts = list(entry.fit.terms), [entry.fit.part(i) for i in range(count)]
    terms[at], parts[at] = plain, parts[at].mean(keepdims=True)
    found = race.entry(problem, problem.fit(terms, np.concatenate(parts), evaluations=30))
    entries = ladder.singles if count == 2 else ladder.pairs
    entries.append(found)
    entries.sort(key=lambda e: e.score)


def _without(problem: Problem, found: Entry, index: int) -> Entry:
  """Returns a hypothesis without one of its terms, fitted to the end."""
  terms = [t for i, t in enumerate(found.fit.terms) if i != index]
  x = np.concatenate([found.fit.part(i) for i in range(len(found.fit.terms)) if i != index])
  return race.entry(problem, problem.fit(terms, x, evaluations=30))


def pairs(ladder: Ladder, *, effort: Effort) -> list[Entry]:
  """Races a second effect on top of each of the best single ones."""
  best = ladder.singles[0].score
  found: list[Entry] = []
  seen: set[frozenset[str]] = set()
  parents: dict[str, Entry] = {}
  for entry in ladder.singles:
    if entry.kind not in _doubles(ladder.problem.plant):
      parents.setdefault(entry.kind, entry)
  for parent in list(parents.values())[: effort.parents]:
    if parent.score > best + effort.parent_margin:
      continue
    problem = ladder.problem
    others = [c for c in beside(problem, parent) if frozenset((c.kind, parent.kind)) not in seen]
    seen |= {frozenset((c.kind, parent.kind)) for c in others}
    base = parent.fit.terms
    found += race.run(problem, base, others, start=parent.fit.x, finalists=4)
  return sorted(found, key=lambda e: e.score)
