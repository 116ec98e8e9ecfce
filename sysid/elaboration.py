"""A richer friction where nothing in the library fits: used in the model, not a ground for a name.

Gears under load rub more than in proportion to it, and hold at rest more than they take in motion.
Such a friction has four values and can imitate much, so it does not take part in the race: it is
fitted where a joint stays unexplained, on top of the hypotheses that came nearest, and kept if it
lowers the error on blocks that it was not fitted to.

Source: Duclusaud, Passault, Padois and Ly 2024, "Extended friction models for the physics
simulation of servo actuators", whose models of load, square and Stribeck this joins in one factor.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from sysid import decision, race
from sysid.explanation import Ladder
from sysid.fitting import Problem
from sysid.kernel import INDEX
from sysid.plant import Output
from sysid.race import Entry
from sysid.terms import Term

_BASES = 4  # hypotheses on top of which it is tried
_FINALISTS = 3  # fitted to the end
_LONGEST = 3  # effects beside it
_LEAST = 0.2  # nats that it must gain on held-out blocks; as decision.Thresholds.second
_REPLACED = ("load_friction", "stribeck_friction", "supply_sag")
"""Kinds that imitate parts of it: strength that falls with torque is like friction that grows."""


def rich_friction(problem: Problem, carried: int) -> Term:
  """Returns load friction with its square and its fall from rest to motion.

  Args:
    problem: the joint.
    carried: which torque loads the gear, as `suite.effects.friction.LoadFriction` has it.
  """
  logs = problem.plant.logs
  fast = max(float(np.quantile(np.abs(np.concatenate([g.velocity for g in logs])), 0.98)), 1e-6)
  torques = np.concatenate([o.torque for o in problem.plant.simulate(problem.plant.declared)[0]])
  large = max(float(np.quantile(np.abs(torques), 0.95)), 1e-6)
  return Term(
    "load_friction",
    problem.plant.joint,
    ("coefficient", "quadratic", "rest", "velocity"),
    (0.0, 0.0, 0.0, 0.002 * fast),
    (0.8, 3.0 / large, 3.0, fast),
    (0.1, 0.2 / large, 0.2, 0.05 * fast),
    ((0.1, 0.3 / large, 0.4, 0.1 * fast), (0.05, 1.0 / large, 0.4, 0.3 * fast)),
    fixed=(("carried", float(carried)),),
  )


def elaborate(ladder: Ladder, chosen: Entry) -> Entry:
  """Returns the chosen hypothesis, or a better one with rich friction.

  Args:
    ladder: the evidence about a joint that stayed unexplained.
    chosen: its hypothesis so far.
  """
  for problem in _readings(ladder.problem):
    best = _best(problem, _bases(ladder, chosen))
    scores = (race.held_out(ladder.problem, e, evaluations=15).score for e in (chosen, best))
    before, after = scores
    if before - after > _LEAST:
      return race.entry(ladder.problem, best.fit)
  return chosen


def _best(problem: Problem, bases: Sequence[tuple[list[Term], np.ndarray]]) -> Entry:
  entries = []
  for terms, start in bases:
    for carried in (0, 1, 2):
      term = rich_friction(problem, carried)
      for begin in term.starts:
        fit = problem.fit([*terms, term], np.concatenate([start, begin]), evaluations=8)
        entries.append(race.entry(problem, fit))
  entries.sort(key=lambda e: e.score)
  fits = [problem.fit(e.fit.terms, e.fit.x, evaluations=60) for e in entries[:_FINALISTS]]
  return min((race.entry(problem, f) for f in fits), key=lambda e: e.score)


class AbsoluteDuty(Problem):
  """A joint whose logged duty is taken at its word: full duty is the actuator's limit."""

  def effort_scale(self, outputs: Sequence[Output]) -> float:
    """Returns duty over torque."""
    return 1.0 / float(self.plant.declared[INDEX["highest"]])


def _readings(problem: Problem) -> list[Problem]:
  """Returns the ways to read a joint's logs, the more telling first."""
  if problem.channel != "duty" or not np.isfinite(problem.plant.declared[INDEX["highest"]]):
    return [problem]
  return [AbsoluteDuty(problem.plant, masks=problem.masks), problem]


def _duty_tells(term: Term, problem: Problem) -> Term:
  """Returns a term that leaves the limit where duties are logged: those saturate as declared."""
  if problem.channel != "duty":
    return term
  fixed = tuple((n, 0.0 if n == "scales_limit" else v) for n, v in term.fixed)
  return dataclasses.replace(term, fixed=fixed)


def _bases(ladder: Ladder, chosen: Entry) -> list[tuple[list[Term], np.ndarray]]:
  """Returns the nearest hypotheses without what rich friction replaces, as terms and values."""
  problem = ladder.problem
  nearest = sorted([*ladder.singles, *ladder.pairs], key=lambda e: e.score)
  found: dict[frozenset[str], tuple[list[Term], np.ndarray]] = {}
  strength = [e for e in nearest if decision.names(e) == {"motor_gain"}][:1]
  for entry in [chosen, *strength, *decision.unique(nearest), ladder.null]:
    kept = [i for i, t in enumerate(entry.fit.terms) if t.kind not in _REPLACED]
    terms = [_duty_tells(entry.fit.terms[i], problem) for i in kept]
    names = frozenset(t.kind for t in terms)
    if len(names) <= _LONGEST + 1:
      found.setdefault(names, (terms, np.concatenate([entry.fit.part(i) for i in kept])))
  last = list(found.values())[: _BASES - 1]
  null = found[frozenset(t.kind for t in ladder.null.fit.terms)]
  return [*last, null] if all(null is not base for base in last) else last
