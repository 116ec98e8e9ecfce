"""Fits recover what was put in; intervals and scores mean what they say."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.fitting import Problem, soft
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.model.measured import fresh, quantum
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.selection import detection, race
from tests.sysid.synthetic import COUNT, PENDULUM, logs_of


def _problem(effects=(), duration: float = 6.0) -> Problem:
  model = mujoco.MjModel.from_xml_string(PENDULUM)
  return Problem(JointPlant(model, "joint", logs_of(PENDULUM, effects, duration=duration)))


def _term(problem: Problem, kind: str):
  return next(t for t in candidates.library(problem.plant) if t.kind == kind)


@pytest.mark.parametrize(
  ("kind", "values", "tolerance"),
  [
    ("command_delay", {"delay": 0.03}, {"delay": 5e-4}),
    ("coulomb_friction", {"torque": 0.15}, {"torque": 0.01}),
    ("motor_gain", {"gain": 0.7}, {"gain": 0.03}),
  ],
)
def test_fit_recovers_an_effect(kind: str, values: dict, tolerance: dict) -> None:
  problem = _problem([Effect(kind, "joint", values)])
  fit = problem.fit([candidates.calibration(problem.plant), _term(problem, kind)])
  for name, value in fit.values(kind).items():
    assert value == pytest.approx(values[name], abs=tolerance[name])
  bounds = intervals.intervals(problem, fit, kind)
  for name, value in values.items():
    low, high = bounds[name]
    assert low - tolerance[name] < value < high + tolerance[name]
    assert high - low < 0.5 * abs(value)


def test_friction_is_known_no_better_than_the_damping_that_was_declared() -> None:
  # Both brake in proportion to speed: only the spread of the declared damping parts them.
  problem = _problem([Effect("viscous_friction", "joint", {"coefficient": 0.3})])
  calibration = candidates.calibration(problem.plant, prior=0.06)
  fit = problem.fit([calibration, _term(problem, "viscous_friction")])
  low, high = intervals.intervals(problem, fit, "viscous_friction")["coefficient"]
  declared = 1.0  # N m s/rad, of the model
  assert (high - low) / 2 == pytest.approx(1.96 * 0.06 * declared, rel=0.2)
  assert low < 0.3 < high


def test_a_delay_may_hold_the_latency_that_a_machine_always_had() -> None:
  problem = _problem([Effect("command_delay", "joint", {"delay": 0.03})])
  term = candidates.calibration(problem.plant)
  sure = [2e-4 if n in race.CLOCKS else p for n, p in zip(term.names, term.prior, strict=True)]
  calibration = dataclasses.replace(term, prior=tuple(sure))
  fit = problem.fit([calibration, _term(problem, "command_delay")])
  delay = fit.values("command_delay")["delay"]
  low, high = intervals.intervals(problem, fit, "command_delay")["delay"]
  assert low < delay - intervals.OWN_LATENCY < delay < high < delay + intervals.OWN_LATENCY


def test_calibration_recovers_constants_that_are_off() -> None:
  truth = {"damping": 1.1, "armature": 0.9, "gain": 1.06}
  problem = _problem([Effect("parameter_error", "joint", truth)])
  fit = problem.fit([candidates.calibration(problem.plant)], evaluations=40)
  found = fit.values("calibration")
  for name, factor in truth.items():
    assert 1 + found[name] == pytest.approx(factor, abs=0.02)


def test_null_of_a_healthy_machine_reaches_the_noise_and_gains_nothing() -> None:
  problem = _problem()
  null = race.entry(problem, problem.fit([candidates.calibration(problem.plant)]))
  assert abs(race.above_floor(null)) < 0.2
  chosen = [_term(problem, k) for k in ("coulomb_friction", "spring", "command_delay")]
  entries = race.run(problem, [candidates.calibration(problem.plant)], chosen, start=null.fit.x)
  assert null.score - entries[0].score < 0.03
  chance = detection.chance_gain(problem, null, entries)
  assert 0 <= chance["median"] <= chance["q95"] < 0.05


def test_held_out_score_is_near_the_fitted_one_for_a_true_hypothesis() -> None:
  problem = _problem([Effect("command_delay", "joint", {"delay": 0.03})])
  fit = problem.fit([candidates.calibration(problem.plant), _term(problem, "command_delay")])
  entry = race.entry(problem, fit)
  assert race.held_out(problem, entry).score == pytest.approx(entry.score, abs=0.05)
  for fitted, held in race.folds(problem):
    for a, b in zip(fitted, held, strict=True):
      assert not np.any(a & b)
      assert np.mean(a) == pytest.approx(0.5, abs=0.1)


def test_soft_residuals_are_linear_far_out() -> None:
  np.testing.assert_allclose(soft(np.array([0.01, -0.01])), [0.01, -0.01], rtol=1e-4)
  far = soft(np.array([400.0, 800.0]))
  assert far[1] ** 2 / far[0] ** 2 == pytest.approx(2.0, rel=0.02)


def test_repeated_readings_are_found_and_rounded_rest_is_not() -> None:
  time = np.arange(0, 1, 0.01)
  position = np.round(np.sin(6 * time) / COUNT) * COUNT
  velocity = 6 * np.cos(6 * time)
  assert fresh(time, position, velocity).all()
  stale = position.copy()
  stale[3] = stale[2]
  assert list(np.flatnonzero(~fresh(time, stale, velocity))) == [3]
  assert quantum(position) == pytest.approx(COUNT)


def test_whitening_leaves_innovations_of_an_autoregression() -> None:
  random = np.random.default_rng(0)
  noise = random.normal(size=4000)
  series = np.zeros(4000)
  for n in range(2, 4000):
    series[n] = 1.2 * series[n - 1] - 0.4 * series[n - 2] + noise[n]
  white = detection.whiten(series)
  np.testing.assert_allclose(np.corrcoef(white, noise[4:])[0, 1], 1.0, atol=0.01)
  assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.05


def test_whitened_tests_see_a_delay() -> None:
  counts = []
  for effects in ((), [Effect("command_delay", "joint", {"delay": 0.03})]):
    problem = _problem(effects)
    tests = detection.tests(problem, problem.fit([]))
    counts.append(sum(t["p"] < 0.01 for t in tests.values()))
  healthy, late = counts
  assert healthy <= 1
  assert late >= 2
