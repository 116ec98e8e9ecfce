"""A richer friction where nothing in the library fits: used in the model, not a ground for a name.

Gears under load rub more than in proportion to it, and hold at rest more than they take in motion.
Such a friction has four values and can imitate much, so it does not take part in the race: it is
fitted where a joint stays unexplained, on top of the hypotheses that came nearest, and kept if it
lowers the error on logs that it was not fitted to. Its form and what it stands on are chosen by
that error too: another motion shows what blocks of the same motion, which are alike, do not.

Where a model is wrong by many times the readings' noise, that noise is no measure of what a log
says: a fit would pay for any friction and any constant that bends one motion towards the readings.
Here residuals are weighed by what the best named hypothesis leaves, so that values stay near where
they are expected unless the logs move them.

Source: Duclusaud, Passault, Padois and Ly 2024, "Extended friction models for the physics
simulation of servo actuators", whose models of load, square and Stribeck this joins in one factor.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.hypotheses.terms import Term, compose
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import Output
from nerf2real.sysid.selection import decision, race
from nerf2real.sysid.selection.explanation import Ladder
from nerf2real.sysid.selection.race import Entry

Array = np.ndarray

_BASES = 4  # hypotheses on top of which it is tried
_FORMS = (0, 1, 2, 3, 4)  # which torque loads the gear: `suite.effects.friction.LoadFriction`
_FINALISTS = 10  # fitted without each log in turn
_HOPELESS = 4.0  # times the least cost at which one is no finalist
_ROUNDS = 4  # of weighing anew
_SETTLED = 0.7  # of the error before at which another round is worth while
_EVALUATIONS = 20  # of a fit that a log was left out of
_LONGEST = 3  # effects beside it
_LEAST = 0.2  # nats that it must gain on held-out logs; as decision.Thresholds.second
_SLOWEST = 0.1
"""Of the fastest speed, most that the fall from rest to motion may take: the authors' published
fits of small servos have 0.07 to 0.11 rad/s and are bounded by 1; ours, some times that."""
_EXPECTED = (("coefficient", 0.1), ("rest", 0.5))
"""Spread about zero: what a motion does not show stays away; ours."""
_REPLACED = ("load_friction", "stribeck_friction", "supply_sag")
"""Kinds that imitate parts of it: strength that falls with torque is like friction that grows."""

_VARIED = (0.93, 1.0, 1.07)
"""Of the dry friction, with which a hypothesis is judged: gears rub by several per cent more or
less from one passage to the next, and a hypothesis that lets the joint stop at the right place only
with its exact friction is right by chance; ours."""
_DRY = [INDEX[n] for n in ("friction", "breakaway", "load_coefficient", "load_square")]


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
  names = ("coefficient", "quadratic", "rest", "velocity")
  expected = dict(_EXPECTED)
  return Term(
    "load_friction",
    problem.plant.joint,
    names,
    (0.0, 0.0, 0.0, 0.002 * fast),
    (0.8, 3.0 / large, 3.0, _SLOWEST * fast),
    (0.1, 0.2 / large, 0.2, 0.05 * fast),
    ((0.1, 0.3 / large, 0.4, 0.1 * fast), (0.05, 1.0 / large, 0.4, 0.03 * fast)),
    tuple(expected.get(name, float("inf")) for name in names),
    fixed=(("carried", float(carried)),),
  )


def elaborate(ladder: Ladder, chosen: Entry) -> Entry:
  """Returns the chosen hypothesis, or a better one with rich friction.

  Args:
    ladder: the evidence about a joint that stayed unexplained.
    chosen: its hypothesis so far.
  """
  _, before = Weighed.by(ladder.problem, chosen).left_out(chosen.fit)
  for kind in _readings(ladder.problem):
    found = _nearest(kind.by(ladder.problem, chosen), _bases(ladder, chosen))
    (_, after), best = min(
      ((kind.by(ladder.problem, e).left_out(e.fit), e) for e in found), key=lambda j: j[0][0]
    )
    if before - after > _LEAST:
      return _settled(kind, ladder.problem, best)
  return chosen


class Weighed(Problem):
  """A joint whose residuals are weighed by what a hypothesis leaves, not by the readings' noise."""

  share = 1.0
  """Noise over that of the readings. The same for efforts: a servo's follow from its positions, and
  if they counted more a fit would follow those alone."""

  @classmethod
  def by(cls, problem: Problem, left: Entry) -> "Weighed":
    """Returns a problem weighed by the positions that a hypothesis leaves."""
    weighed = cls(problem.plant, masks=problem.masks)
    weighed.share = max(1.0, float(np.sqrt(np.mean(np.square(left.levels[:, 0])))))
    return weighed._scaled()

  def _scaled(self) -> "Weighed":
    self.position_noise *= self.share
    self.effort_noise *= self.share
    return self

  def masked(self, masks: Sequence[Array]) -> "Weighed":
    """Returns the same problem on part of the samples."""
    part = type(self)(self.plant, masks=masks)
    part.share = self.share
    return part._scaled()

  def varied(self, fit: Fit, factor: float) -> list[Output]:
    """Simulates the logs with all dry friction times a factor."""
    p, changed = compose(self.plant, fit.terms, fit.x)
    p[_DRY] *= factor
    return self.plant.simulate(p[None], surroundings=[changed])[0]

  def left_out(self, fit: Fit) -> tuple[float, float]:
    """Returns the error on logs that were not fitted: mean log rms over them in noise units, nats.

    Args:
      fit: hypothesis, fitted anew without each log in turn, from these values and from other starts
        of its last term.

    Returns:
      Of positions and efforts, weighed as in a race; of positions alone.
    """
    rows = []
    for fitted, held in race.folds_by_log(self):
      part = self.masked(fitted)
      fits = [part.fit(fit.terms, x, evaluations=_EVALUATIONS) for x in _starts(fit)]
      best = min(fits, key=lambda f: f.cost)
      rows += self._levels(best, held)
    logs = 0.5 * np.log(race.FLOOR + np.square(self.share * np.array(rows))).mean(axis=0)
    weight = np.array([1.0, race.EFFORT_SHARE])[: len(logs)]
    return float(logs @ weight), float(logs[0])

  def _levels(self, fit: Fit, masks: Sequence[Array]) -> list[Array]:
    """Returns the rms of each channel, over varied friction, in each log that has samples."""
    rows = []
    for factor in _VARIED:
      errors = self.errors(self.varied(fit, factor))
      rows.append(
        [
          [np.mean(np.square(c[mask])) for c in channels if c is not None]
          for channels, mask in zip(errors, masks, strict=True)
          if mask.any()
        ]
      )
    return list(np.sqrt(np.mean(rows, axis=0)))


def _starts(fit: Fit) -> list[Array]:
  """Returns the values of a fit, and those with its last term at each of that term's starts."""
  if not fit.terms:
    return [fit.x]
  rest = fit.x[: len(fit.x) - len(fit.terms[-1].names)]
  return [fit.x, *(np.concatenate([rest, begin]) for begin in fit.terms[-1].starts)]


class AbsoluteDuty(Weighed):
  """A joint whose logged duty is taken at its word: full duty is the actuator's limit."""

  def effort_scale(self, outputs: Sequence[Output]) -> float:
    """Returns duty over torque."""
    return 1.0 / float(self.plant.declared[INDEX["highest"]])


def _nearest(problem: Weighed, bases: Sequence[tuple[list[Term], Array]]) -> list[Entry]:
  """Returns the finalists: forms and bases that fit all logs best after a few steps."""
  fits = []
  for terms, start in bases:
    for carried in _FORMS:
      term = rich_friction(problem, carried)
      tried = [
        problem.fit([*terms, term], np.concatenate([start, begin]), evaluations=8)
        for begin in term.starts
      ]
      fits.append(min(tried, key=lambda f: f.cost))
  fits.sort(key=lambda f: f.cost)
  plain = Problem(problem.plant, masks=problem.masks)
  return [race.entry(plain, f) for f in fits[:_FINALISTS] if f.cost < _HOPELESS * fits[0].cost]


def _settled(kind: type[Weighed], problem: Problem, found: Entry) -> Entry:
  """Returns a hypothesis fitted to the end, weighed by what it leaves itself."""
  for _ in range(_ROUNDS):
    weighed = kind.by(problem, found)
    fits = [weighed.fit(found.fit.terms, x, evaluations=60) for x in _starts(found.fit)]
    before, found = found, race.entry(problem, min(fits, key=lambda f: f.cost))
    if found.levels.max() > _SETTLED * before.levels.max():
      break
  return found


def _readings(problem: Problem) -> list[type[Weighed]]:
  """Returns the ways to read a joint's logs, the more telling first."""
  if problem.channel != "duty" or not np.isfinite(problem.plant.declared[INDEX["highest"]]):
    return [Weighed]
  return [AbsoluteDuty, Weighed]


def _duty_tells(term: Term, problem: Problem) -> Term:
  """Returns a term that leaves the limit where duties are logged: those saturate as declared."""
  if problem.channel != "duty":
    return term
  fixed = tuple((n, 0.0 if n == "scales_limit" else v) for n, v in term.fixed)
  return dataclasses.replace(term, fixed=fixed)


def _bases(ladder: Ladder, chosen: Entry) -> list[tuple[list[Term], Array]]:
  """Returns the nearest hypotheses without what rich friction replaces, as terms and values."""
  problem = ladder.problem
  nearest = sorted([*ladder.singles, *ladder.pairs], key=lambda e: e.score)
  found: dict[frozenset[str], tuple[list[Term], Array]] = {}
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
