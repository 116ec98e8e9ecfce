"""How hypotheses grow and shrink, and what the verdict over several joints is."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.selection import claims, decision, explanation, identification, joint, race
from tests.sysid.synthetic import PENDULUM, logs_of


def _problem(*effects: Effect) -> Problem:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  return Problem(JointPlant(model, "joint", logs_of(PENDULUM, effects, duration=6.0)))


def _terms(problem: Problem, *kinds: str):
  library = candidates.library(problem.plant)
  return [next(t for t in library if t.kind == kind) for kind in kinds]


def test_effects_that_are_idle_are_taken_out_again() -> None:
  problem = _problem(
    Effect("command_delay", "joint", {"delay": 0.04}),
    Effect("torque_limit", "joint", {"limit": 1.4}),
  )
  calibration, declared, null = explanation.bare(problem)
  terms = [calibration, *_terms(problem, "motor_gain", "command_delay", "torque_limit")]
  start = np.concatenate([null.fit.x, [1.0, 0.04, 1.4]])
  grown = race.entry(problem, problem.fit(terms, start))
  single = race.entry(problem, problem.fit([calibration, terms[1]], evaluations=7))
  ladder = explanation.Ladder(problem, calibration, declared, null, [single], [grown])
  explanation.prune(ladder)
  assert decision.names(ladder.pairs[0]) == {"command_delay", "torque_limit"}
  assert decision.decide(ladder).verdict == "effects"
  # Neither of the two is idle.
  assert len(ladder.singles) == 1


def test_a_fit_leaves_a_valley_of_friction() -> None:
  problem = _problem(Effect("stribeck_friction", "joint", {"breakaway": 0.3, "velocity": 0.12}))
  calibration, _, null = explanation.bare(problem)
  (term,) = _terms(problem, "stribeck_friction")
  far = np.concatenate([null.fit.x, [0.02, term.low[1]]])
  fit = problem.fit([calibration, term], far, evaluations=30)
  assert fit.values("stribeck_friction")["velocity"] == pytest.approx(0.12, rel=0.3)
  assert fit.values("stribeck_friction")["breakaway"] == pytest.approx(0.3, rel=0.2)


@pytest.mark.parametrize(
  ("named", "unexplained", "expected"),
  [([0.5] * 9, [1.0], True), ([0.4, 0.3], [1.0], False), ([], [1.0], False)],
)
def test_a_verdict_is_that_of_what_the_joints_leave(named, unexplained, expected) -> None:
  found = [
    SimpleNamespace(
      finding=SimpleNamespace(verdict=verdict), screened=SimpleNamespace(excess=excess)
    )
    for verdict, values in (("effects", named), ("unexplained", unexplained), ("none", [3.0]))
    for excess in values
  ]
  assert identification._mostly_explained(found) is expected


def test_an_even_asymmetric_friction_is_a_plain_one() -> None:
  problem = _problem(Effect("coulomb_friction", "joint", {"torque": 0.2}))
  calibration, declared, null = explanation.bare(problem)
  (term,) = _terms(problem, "asymmetric_friction")
  even = race.entry(problem, problem.fit([calibration, term]))
  assert explanation.is_even(even)
  ladder = explanation.Ladder(problem, calibration, declared, null, [even], [])
  explanation.even_out(ladder)
  assert decision.names(decision.decide(ladder).chosen) == {"coulomb_friction"}
  # One that holds more in one direction stays what it is.
  problem = _problem(Effect("asymmetric_friction", "joint", {"positive": 0.2, "negative": 0.05}))
  calibration, declared, null = explanation.bare(problem)
  lopsided = race.entry(problem, problem.fit([calibration, term]))
  ladder = explanation.Ladder(problem, calibration, declared, null, [lopsided], [])
  explanation.even_out(ladder)
  assert ladder.singles == [lopsided]


def test_of_equal_explanations_the_usual_one_is_named() -> None:
  def entry(score: float, *kinds: str):
    counts = {"payload": 4, "spring": 2, "encoder_offset": 1, "backlash": 1, "command_delay": 1}
    terms = [SimpleNamespace(kind=k, names=("",) * counts[k]) for k in kinds]
    x = np.zeros(sum(counts[k] for k in kinds))
    return SimpleNamespace(score=score, fit=SimpleNamespace(terms=terms, x=x))

  def first(*entries):
    return {t.kind for t in decision.usual_first(list(entries), alone=True)[0].fit.terms}

  assert first(entry(0.50, "spring"), entry(0.51, "payload")) == {"payload"}
  assert first(entry(0.50, "spring"), entry(0.60, "payload")) == {"spring"}  # no tie
  assert first(entry(0.50, "payload"), entry(0.55, "encoder_offset")) == {"encoder_offset"}
  assert first(entry(0.50, "encoder_offset"), entry(0.55, "payload")) == {"encoder_offset"}
  pairs = entry(0.50, "payload", "backlash"), entry(0.51, "encoder_offset", "backlash")
  assert first(*pairs) == {"encoder_offset", "backlash"}  # two values fewer
  pairs = entry(0.5, "spring", "command_delay"), entry(0.51, "payload", "command_delay")
  assert first(*pairs) == {"payload", "command_delay"}


@pytest.mark.parametrize(("gain", "expected"), [(1.0, {"motor_gain"}), (0.8, set())])
def test_an_effect_that_may_be_nothing_is_told(gain: float, expected: set[str]) -> None:
  problem = _problem(Effect("motor_gain", "joint", {"gain": gain}))
  calibration, declared, null = explanation.bare(problem)
  (term,) = _terms(problem, "motor_gain")
  entry = race.entry(problem, problem.fit([calibration, term]))
  ladder = explanation.Ladder(problem, calibration, declared, null, [entry], [])
  assert joint.may_be_nothing(ladder, entry) == expected


def test_of_two_effects_the_one_that_may_be_nothing_goes() -> None:
  problem = _problem(Effect("coulomb_friction", "joint", {"torque": 0.2}))
  calibration, declared, null = explanation.bare(problem)
  friction, play = _terms(problem, "coulomb_friction", "backlash")
  single = race.entry(problem, problem.fit([calibration, friction]))
  start = np.concatenate([single.fit.x, play.starts[0]])
  pair = race.entry(problem, problem.fit([calibration, friction, play], start, evaluations=30))
  assert "backlash" in joint.may_be_nothing(
    explanation.Ladder(problem, calibration, declared, null, [single], [pair]), pair
  )
  ladder = explanation.Ladder(problem, calibration, declared, null, [single], [pair])
  finding = decision.Finding("effects", pair, True, False, [], [])
  item = joint.Found(None, ladder, finding, {}, decision.Thresholds())
  kept = joint.without_nothing(item, 0.06)
  assert decision.names(kept) == {"coulomb_friction"}
  assert item.finding.verdict == "effects"
  # What stays must gain enough by itself.
  item = joint.Found(None, ladder, finding, {}, decision.Thresholds(gain=10.0))
  assert not decision.names(joint.without_nothing(item, 0.06))
  assert not item.finding.named


def test_an_effect_of_no_size_is_idle() -> None:
  problem = _problem()
  calibration, _, null = explanation.bare(problem)
  payload, friction = _terms(problem, "payload", "asymmetric_friction")

  def entry(term, values: list[float]):
    x = np.concatenate([null.fit.x, values])
    return race.entry(problem, Fit((calibration, term), x, 0.0, 1.0, 0))

  assert claims.is_idle(entry(payload, [0.0, 0.1, 0.0, -0.1]), payload)
  assert not claims.is_idle(entry(payload, [0.1, 0.0, 0.0, 0.0]), payload)
  assert not claims.is_idle(entry(friction, [0.0, 0.1]), friction)
