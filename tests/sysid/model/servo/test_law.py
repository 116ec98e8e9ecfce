"""The law of a servo that logs its duty, on duties made by hand."""

import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import JointSeries
from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit.layout import Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses import candidates
from nerf2real.sysid.hypotheses.constants import constants
from nerf2real.sysid.hypotheses.terms import SERVO_GAIN
from nerf2real.sysid.model.joint import JointModel
from nerf2real.sysid.model.servo.duty import duty_of
from nerf2real.sysid.model.servo.law import servo_law
from tests.sysid.synthetic import PENDULUM, log_of

STEP = 1.0 / 885  # of the PWM's counts
DECLARED = 21.0 / 4.0  # duty a rad


def plant_of(
  *, gain=1.0, delay=0.0, drift=0.0, band=0.0, integral=0.0, top=1.0, noise=0.0, effects=()
):
  """Returns a joint with duties that follow a law from its readings."""
  logs, random = [], np.random.default_rng(0)
  for seed, kind in enumerate(("sweep", "slow")):
    log = log_of(PENDULUM, kind, effects, duration=5.0, seed=seed)
    time, position = log.states.stamp, log.states.position[:, 0]
    late = time * (1.0 - drift) - delay
    sent = np.searchsorted(log.commands.stamp, late, side="right") - 1
    error = log.commands.position[np.clip(sent, 0, None), 0] - position
    error = np.sign(error) * np.maximum(np.abs(error) - band, 0.0)
    duty = gain * DECLARED * error + integral * DECLARED * np.cumsum(error * np.gradient(time))
    duty = np.clip(duty + noise * random.normal(size=len(time)), -top, top)
    duty = np.round(duty / STEP) * STEP
    pwm = JointSeries(("joint",), time, time, None, None, duty[:, None])
    logs.append(dataclasses.replace(log, pwm=pwm))
  return JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)


def law_of(**law):
  found = servo_law(plant_of(**law))
  assert found is not None
  return found[0]


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.3])
def test_the_gain_is_in_its_interval_which_is_narrow(gain):
  law = law_of(gain=gain, noise=0.002)
  low, high = law.interval
  assert low < gain < high
  assert high - low < 0.02 * gain
  assert law.left < 0.004
  assert (law.delay, law.dead_band) == (pytest.approx(0.0, abs=0.005), 0.0)


def test_delay_dead_band_and_saturation_are_found():
  law = law_of(gain=0.8, delay=0.03, band=0.012, top=0.4)
  assert law.delay == pytest.approx(0.03, abs=0.006)
  assert law.dead_band == pytest.approx(0.012, rel=0.3)
  assert law.saturation == pytest.approx(0.4, abs=0.01)
  assert law.gain == pytest.approx(0.8, rel=0.01)


@pytest.mark.parametrize("delay", [0.07, 0.18])
def test_a_command_as_late_as_is_plausible_is_no_weaker_gain(delay):
  law = law_of(delay=delay, noise=0.002)
  assert law.delay == pytest.approx(delay, abs=0.005)
  assert law.gain == pytest.approx(1.0, abs=0.01)
  assert not law.is_off(0.05)


@pytest.mark.parametrize("drift", [0.004, -0.006, 0.015])
def test_a_clock_that_drifts_is_found_and_is_no_weaker_gain(drift):
  law = law_of(drift=drift, delay=0.01, noise=0.002)
  assert law.rate == pytest.approx(drift, abs=8e-4)
  assert law.delay == pytest.approx(0.01, abs=0.008)
  assert law.gain == pytest.approx(1.0, abs=0.01)
  assert not law.is_off(0.05)


def test_a_clock_that_does_not_drift_has_no_rate():
  assert law_of(gain=0.5, noise=0.002).rate == 0.0
  assert law_of(gain=0.5, noise=0.002).is_off(0.05)


def test_a_law_that_leaves_more_than_it_makes_is_not_off():
  assert not dataclasses.replace(law_of(), gain=0.3, unexplained=1.6).is_off(0.2)
  law = servo_law(plant_of(drift=0.04, noise=0.002))
  assert law is None or not law[0].is_off(0.05)


def test_a_gain_whose_interval_holds_the_declared_one_is_not_off():
  law = dataclasses.replace(law_of(noise=0.002), gain=0.99, gain_deviation=0.09, unexplained=0.03)
  assert not law.is_off(0.03)
  assert dataclasses.replace(law, gain=0.7).is_off(0.03)
  assert dataclasses.replace(law, gain=1.3).is_off(0.03)


@pytest.mark.parametrize(("gain", "noise"), [(-0.5, 0.002), (0.02, 0.3)])
def test_a_duty_that_is_not_of_the_position_error_has_no_law(gain, noise):
  assert servo_law(plant_of(gain=gain, noise=noise)) is None


def test_an_integral_is_found_where_there_is_one():
  none, some = law_of(noise=0.001), law_of(integral=0.5, noise=0.001)
  assert abs(none.integral) < 3.0 * none.integral_deviation + 0.01
  assert some.integral == pytest.approx(0.5, rel=0.1)
  assert abs(some.integral) > 3.0 * some.integral_deviation


def test_without_duty_there_is_no_law():
  logs = [log_of(PENDULUM, "slow", duration=3.0)]
  plant = JointModel(mujoco.MjModel.from_xml_string(PENDULUM), "joint", logs)
  assert servo_law(plant) is None


def test_constants_hold_the_law_of_a_gain_that_is_off():
  """Moves as with 0.6 of the gain, tells duties of 0.5 of it."""
  weaker = [Effect("motor_gain", "joint", {"gain": 0.6})]
  plant = plant_of(gain=0.5, noise=0.001, effects=weaker)
  own = constants(plant)
  assert dict(own.fixed)[SERVO_GAIN] == pytest.approx(0.5, rel=0.01)
  effect = own.effect(np.array(own.starts[0]))
  assert effect.parameters["gain"] == pytest.approx(0.5, rel=0.01)
  assert effect.parameters["limit"] == 1.0
  with_interval = own.effect(np.array(own.starts[0]), {"gain": (-0.02, 0.04)})
  assert with_interval.intervals["limit"] == pytest.approx((0.98, 1.04))
  assert with_interval.intervals["gain"] == pytest.approx((0.49, 0.52), rel=0.01)
  p = plant.declared.copy()
  own.apply(plant, p, np.array(own.starts[0]))
  left = plant.logs[0].duty - duty_of(plant, p, 0)
  assert np.sqrt(np.mean(left**2)) < 0.01
  assert SERVO_GAIN not in dict(constants(plant_of(gain=1.01)).fixed)


def test_the_duty_alone_sets_the_gain_of_a_motion_that_says_another():
  """Moves as with 0.6 of the gain, tells duties of 0.5 of it."""
  weaker = [Effect("motor_gain", "joint", {"gain": 0.6})]
  joint = JointLikelihood(plant_of(gain=0.5, noise=0.001, effects=weaker))
  own = constants(plant_of())  # of a healthy reference
  term = next(
    t
    for t in candidates.library(joint.plant)
    if t.kind == "motor_gain" and dict(t.fixed)["scales_limit"] == 0.0
  )
  start = np.concatenate([own.starts[0], [0.75]])
  joint.rescale(joint.residuals((own, term), start[None])[0])
  fit = Fitter([joint], Layout([(own, term)])).fit(start, iterations=6)
  assert fit.values(term)["gain"] == pytest.approx(0.5, rel=0.01)
