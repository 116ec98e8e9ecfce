"""Fits recover what was put in; intervals mean what they say."""

import dataclasses

import numpy as np
import pytest

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import intervals, rough, whitening
from nerf2real.sysid.fit.layout import CONSTANTS, Layout
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.model.measured import fresh, quantum
from nerf2real.sysid.selection.joints.baseline import widened
from nerf2real.sysid.selection.search.evidence import Scored
from nerf2real.sysid.selection.search.explain import Explainer
from nerf2real.sysid.settings import SETTINGS
from tests.sysid.fit.test_likelihood import joint_of
from tests.sysid.synthetic import COUNT

KINDS = ("sweep", "slow", "steps")


def _fitted(effect: Effect) -> tuple[Explainer, Scored]:
  """Returns a joint with an effect, fitted with that kind."""
  _, joint = joint_of(KINDS, [effect])
  library = [t for t in candidates.library(joint.plant) if t.kind == effect.kind]
  explainer = Explainer(joint, constants(joint.plant), library)
  return explainer, explainer.adopt(
    max(explainer.extend(explainer.null, 1), key=lambda s: s.evidence)
  )


def test_what_every_machine_has_widens_the_values_of_some_effects() -> None:
  _, joint = joint_of(("sweep",))
  usual = intervals.Usual(friction=0.1, dry=1.0, bend=0.02)
  terms = {t.kind: t for t in candidates.library(joint.plant)}

  def deviation(kind: str, name: str, value: float) -> float:
    return intervals.unmodelled(terms[kind], name, value, usual=usual)

  assert deviation("stribeck_friction", "breakaway", 0.5) == pytest.approx(1.5 * intervals.PEAK)
  assert deviation("quadratic_drag", "coefficient", 0.0) == pytest.approx(0.02)
  assert deviation("coulomb_friction", "torque", 0.0) == pytest.approx(0.1 * intervals.RUBS)
  assert deviation("viscous_friction", "coefficient", 1.0) == pytest.approx(intervals.RELATIVE)
  explainer = Explainer(joint, constants(joint.plant), ())
  fastest = candidates.typical_speed(joint.plant)
  share = dict(SETTINGS.tolerances)["damping"]
  of_joint = intervals.usual_of(joint, explainer.null.fit)
  assert of_joint.bend == pytest.approx(share * 1.0 / fastest)  # damping of 1 N m s/rad
  assert of_joint.dry == of_joint.friction == pytest.approx(0.03)


def test_friction_at_rest_is_looked_for_up_to_what_the_actuator_does() -> None:
  """One that is beyond half of a typical torque moves all the same, at the largest."""
  _, joint = joint_of(("sweep",))
  (term,) = [t for t in candidates.library(joint.plant) if t.kind == "stribeck_friction"]
  most = dict(zip(term.names, term.high, strict=True))["breakaway"]
  assert most == joint.plant.declared_torque().max()
  assert most > 0.5 * candidates.typical_torque(joint.plant)


def _intervals(explainer: Explainer, item: Scored, kind: str) -> dict:
  term = next(t for t in item.terms if t.kind == kind)
  return intervals.intervals(explainer.joint, item.fit, term, own_latency=True)


@pytest.mark.parametrize(
  ("kind", "values", "tolerance"),
  [
    ("command_delay", {"delay": 0.03}, {"delay": 5e-4}),
    ("coulomb_friction", {"torque": 0.15}, {"torque": 0.01}),
    ("motor_gain", {"gain": 0.7}, {"gain": 0.03}),
  ],
)
def test_fit_recovers_an_effect(kind: str, values: dict, tolerance: dict) -> None:
  explainer, found = _fitted(Effect(kind, "joint", values))
  for name, value in found.values(kind).items():
    if name in values:
      assert value == pytest.approx(values[name], abs=tolerance[name])
  bounds = _intervals(explainer, found, kind)
  for name, value in values.items():
    low, high = bounds[name]
    assert low - tolerance[name] < value < high + tolerance[name]
    assert high - low < 0.5 * abs(value)


def test_a_clock_is_sought_by_how_late_it_makes_the_end_of_a_log() -> None:
  """Held commands make stairs of its rate, too, in which steps end."""
  true = 0.004
  _, joint = joint_of(KINDS, [Effect("clock_drift", None, {"rate": true})])
  (drift,) = [t for t in candidates.library(joint.plant) if t.kind == "clock_drift"]
  ends = np.abs(drift.starts) * max(log.time[-1] for log in joint.plant.logs)
  assert ends.min() < 0.005 and ends.max() > 0.15  # s, as of late commands
  fitter = Fitter([joint], Layout([[constants(joint.plant), drift]]))
  off = np.append(np.array(constants(joint.plant).starts[0]), true - 3e-4)
  fit = fitter.linearise(off)
  found = rough.look_about(fitter, fit, rough.STAIRS, iterations=0)
  assert found.cost < fit.cost
  assert abs(found.x[-1] - true) < 1e-4


def test_friction_is_known_no_better_than_the_damping_that_was_declared() -> None:
  # Both brake in proportion to speed: only the spread of the declared damping parts them.
  explainer, found = _fitted(Effect("viscous_friction", "joint", {"coefficient": 0.3}))
  low, high = _intervals(explainer, found, "viscous_friction")["coefficient"]
  spread = dict(SETTINGS.tolerances)["damping"] * 1.0  # N m s/rad, of the model
  assert (high - low) / 2 == pytest.approx(1.96 * spread, rel=0.2)
  assert low < 0.3 < high


def test_a_delay_may_hold_the_latency_that_a_machine_always_had() -> None:
  explainer, found = _fitted(Effect("command_delay", "joint", {"delay": 0.03}))
  delay = found.values("command_delay")["delay"]
  low, high = _intervals(explainer, found, "command_delay")["delay"]
  assert low < delay - intervals.OWN_LATENCY < delay < high < delay + intervals.OWN_LATENCY


def test_torques_are_known_no_better_than_a_reference_shows_their_scale() -> None:
  """A spring is stiffer by as much as all torques may be larger."""
  scale = 0.2
  _, joint = joint_of(KINDS, [Effect("spring", "joint", {"stiffness": 2.0, "reference": 0.5})])
  own = constants(joint.plant, healthy=True)
  larger = np.isin(own.names, ("damping", "armature", "friction", "gain", "mass"))
  known = dataclasses.replace(own, prior=(1e-5,) * len(own.names))
  shown = tuple(map(tuple, (scale**2 * np.outer(larger, larger)).tolist()))
  (spring,) = [t for t in candidates.library(joint.plant) if t.kind == "spring"]
  half = []
  for constant in (known, dataclasses.replace(known, open=shown)):
    explainer = Explainer(joint, constant, [spring])
    (found,) = explainer.extend(explainer.null, 1)
    low, high = _intervals(explainer, found, "spring")["stiffness"]
    half.append((high - low) / 2 / found.values("spring")["stiffness"])
  assert half[0] < 0.8 * scale
  assert np.sqrt(half[1] ** 2 - half[0] ** 2) == pytest.approx(1.96 * scale, rel=0.1)


def test_constants_that_are_off_are_recovered() -> None:
  truth = {"damping": 1.1, "armature": 0.9, "gain": 1.04}
  _, joint = joint_of(KINDS, [Effect("parameter_error", "joint", truth)])
  explainer = Explainer(joint, widened(constants(joint.plant)), ())
  values = explainer.null.values(CONSTANTS)
  for name, factor in truth.items():
    assert 1 + values[name] == pytest.approx(factor, abs=0.02)


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
  white = whitening.whiten(series)
  np.testing.assert_allclose(np.corrcoef(white, noise[4:])[0, 1], 1.0, atol=0.01)
  assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.05


def test_whitened_tests_see_a_delay() -> None:
  counts = []
  for effects in ((), [Effect("command_delay", "joint", {"delay": 0.03})]):
    _, joint = joint_of(KINDS, effects)
    residual = joint.residuals((), np.zeros((1, 0)))[0, 0]
    counts.append(sum(t["p"] < 0.01 for t in whitening.tests(joint, residual).values()))
  healthy, late = counts
  assert healthy <= 1
  assert late >= 2
