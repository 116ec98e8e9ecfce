"""The sensor path: sampling at 125 Hz, chip filter, delay, jitter and history."""

import numpy as np
import pytest
import scipy.signal

from nerf2real.suite import specs
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.proprioception import Proprioception

TIMESTEP, SUBSTEPS = 0.0025, 10


def _run(truth_imu, truth_joints, steps, *, imu_delay=0.0, joint_delay=0.0, jitter=0.0, seed=0):
  """Feeds functions of time; returns the newest readings after each control step by name."""
  path = Proprioception(physics_timestep=TIMESTEP, substeps=SUBSTEPS)
  path.reset(
    truth_imu(0.0),
    truth_joints(0.0),
    np.zeros(20),
    imu_delay=imu_delay,
    joint_delay=joint_delay,
    jitter=jitter,
    rng=np.random.default_rng(seed),
  )
  found = {name: [] for name in specs.PROPRIOCEPTION}
  for step in range(steps):
    for sub in range(SUBSTEPS):
      time = (step * SUBSTEPS + sub + 1) * TIMESTEP
      path.record(sub, truth_imu(time), truth_joints(time))
    path.finish_step(np.full(20, step))
    for name in found:
      found[name].append(path.histories.read(name)[-1])
  return path, {name: np.array(values) for name, values in found.items()}


def _level(_):
  return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])


def _ramp(time):
  return np.linspace(1, -2, 20) * time


def test_encoders_are_sampled_every_8_ms_and_quantised():
  _, found = _run(_level, _ramp, 24)
  for step, value in enumerate(found["joint_positions"], start=1):
    tick = np.floor(step * 0.025 / 0.008 + 1e-9) * 0.008  # the last tick of the bus
    np.testing.assert_allclose(value, _ramp(tick), atol=constants.ENCODER_STEP / 2 + 1e-6)
    counts = value / constants.ENCODER_STEP
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-3)


def test_delay_is_that_of_the_episode():
  for delay in (0.010, 0.030, 0.050):
    _, found = _run(_level, _ramp, 60, joint_delay=delay)
    ages = np.arange(1, 61) * 0.025 - found["joint_positions"][:, 0]
    ages = ages[5:]  # after the start
    # The newest sample that is at least `delay` old: between delay and one bus period more.
    assert ages.min() >= delay - constants.ENCODER_STEP
    assert ages.max() <= delay + 0.008 + constants.ENCODER_STEP
    assert ages.mean() == pytest.approx(delay + 0.0035, abs=0.001)


def test_jitter_spreads_the_age_and_never_reaches_into_the_future():
  _, still = _run(_level, _ramp, 800, joint_delay=0.020)
  _, shaken = _run(_level, _ramp, 800, joint_delay=0.020, jitter=0.005)
  age = [np.arange(1, 801) * 0.025 - found["joint_positions"][:, 0] for found in (still, shaken)]
  still_age, age = age[0][10:], age[1][10:]
  assert age.std() > still_age.std() + 0.0003
  assert age.min() >= 0.015 - constants.ENCODER_STEP
  assert age.max() <= 0.025 + 0.008 + constants.ENCODER_STEP


def test_imu_ends_at_the_chips_range():
  def truth(time):
    hard = time > 0.3
    return np.array([40.0 * hard, -1.0, 0.0, 0.0, -30.0 * hard, 9.81 + 20.0 * hard])

  _, found = _run(truth, lambda t: np.zeros(20), 20)
  np.testing.assert_allclose(found["gyroscope"][5], [0, -1, 0], atol=1e-6)
  np.testing.assert_allclose(found["gyroscope"][-1], [np.deg2rad(1998), -1, 0], rtol=1e-4)
  np.testing.assert_allclose(found["accelerometer"][5], [0, 0, 9.81], atol=1e-6)
  two_g = 19.6133  # m/s^2
  np.testing.assert_allclose(found["accelerometer"][-1], [0, -two_g, two_g], rtol=1e-6)


def test_imu_passes_the_chips_low_pass():
  frequency = 41.0  # Hz: the chip's bandwidth, where a first-order filter passes 1/sqrt(2)

  def truth(time):
    return np.array([0, 0, np.sin(2 * np.pi * frequency * time), 0, 0, 9.81])

  steps = 400
  _, found = _run(truth, lambda t: np.zeros(20), steps)
  times = np.arange(1, steps * SUBSTEPS + 1) * TIMESTEP
  b, a = scipy.signal.butter(1, filters.CHIP_BANDWIDTH_HZ, fs=1 / TIMESTEP)
  expected = scipy.signal.lfilter(b, a, np.sin(2 * np.pi * frequency * times))
  arrival = np.arange(1, steps + 1) * 0.025 - filters.CHIP_DELAY
  ticks = np.floor(arrival / 0.008 + 1e-9) * 0.008
  np.testing.assert_allclose(found["gyroscope"][:, 2], np.interp(ticks, times, expected), atol=1e-5)
  assert np.abs(found["gyroscope"][100:, 2]).max() == pytest.approx(np.sqrt(0.5), abs=0.03)


def test_gravity_is_that_of_a_turning_body():
  rate = 0.8  # rad/s about y

  def truth(time):
    angle = rate * time
    return np.array([0, rate, 0, -9.81 * np.sin(angle), 0, 9.81 * np.cos(angle)])

  _, found = _run(truth, lambda t: np.zeros(20), 60)
  angle = rate * (60 * 0.025 - 0.004)
  expected = [np.sin(angle), 0, -np.cos(angle)]
  np.testing.assert_allclose(found["gravity"][-1], expected, atol=0.02)
  np.testing.assert_allclose(np.linalg.norm(found["gravity"], axis=1), 1, atol=1e-6)


def test_history_is_oldest_first_and_starts_full():
  path, _ = _run(_level, lambda t: np.zeros(20), 3)
  control = path.histories.read("previous_control")
  np.testing.assert_array_equal(control[:, 0], [0, 0, 0, 1, 2])
  assert control.dtype == np.float32 and path.histories.read("accelerometer").shape == (5, 3)
  np.testing.assert_allclose(
    path.histories.read("accelerometer"), np.tile([0, 0, 9.81], (5, 1)), rtol=1e-6
  )
  copy = path.histories.read("gravity")
  copy[:] = 7
  assert (path.histories.read("gravity") != 7).all()
