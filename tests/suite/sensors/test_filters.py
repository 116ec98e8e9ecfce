"""Filters against scipy.signal, the ahrs package and measured attitude."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.signal

from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.madgwick import BETA, SAMPLE_RATE_HZ, Madgwick

_IMU = Path(__file__).parents[4] / "shared" / "data" / "imu"


@pytest.mark.parametrize(("cutoff", "rate"), [(41.0, 400.0), (41.0, 125.0), (5.0, 1000.0)])
def test_low_pass_equals_scipy(cutoff, rate):
  signal = np.random.default_rng(0).normal(size=(200, 3))
  signal[0] = 0.0
  b, a = scipy.signal.butter(1, cutoff, fs=rate)
  low_pass = filters.LowPass(cutoff, rate)
  result = np.array([low_pass(sample) for sample in signal])
  np.testing.assert_allclose(result, scipy.signal.lfilter(b, a, signal, axis=0), atol=1e-12)


def test_low_pass_starts_in_steady_state():
  low_pass = filters.LowPass(10.0, 125.0)
  for _ in range(5):
    np.testing.assert_allclose(low_pass(np.array([0.0, 0.0, 9.81])), [0, 0, 9.81], rtol=1e-12)
  low_pass.reset()
  assert low_pass(np.array([1.0]))[0] == pytest.approx(1.0)


def test_chip_model_has_the_data_sheet_delay():
  # MPU-9250, gyroscope, bandwidth 41 Hz: 5.9 ms (first-order lag and the transport delay).
  rate = 8000.0
  low_pass = filters.LowPass(filters.CHIP_BANDWIDTH_HZ, rate)
  ramp = np.arange(4000) / rate
  out = np.array([low_pass(np.array([x]))[0] for x in ramp])
  assert ramp[-1] - out[-1] + filters.CHIP_DELAY == pytest.approx(0.0059, abs=0.0002)


def test_low_pass_rejects_a_cutoff_above_half_the_rate():
  with pytest.raises(ValueError, match="half the sampling rate"):
    filters.LowPass(80.0, 125.0)


def test_exponential_filter_keeps_the_strength_of_the_old_value():
  smooth = filters.ExponentialFilter(0.8)
  smooth.reset(np.zeros(2))
  # 1 - 0.8^k
  values = [smooth(np.array([1.0, -1.0])) for _ in range(3)]
  np.testing.assert_allclose(np.array(values)[:, 0], [0.2, 0.36, 0.488])
  np.testing.assert_allclose(np.array(values)[:, 1], [-0.2, -0.36, -0.488])
  smooth.reset()
  assert smooth(np.array([3.0]))[0] == 3.0


def test_madgwick_equals_ahrs():
  ahrs = pytest.importorskip("ahrs", reason="the ahrs package, an independent implementation")
  rng = np.random.default_rng(3)
  ours = Madgwick()
  theirs = ahrs.filters.Madgwick(frequency=SAMPLE_RATE_HZ, gain=BETA)
  ours.update(np.zeros(3), np.array([0.2, -0.4, 9.0]))
  attitude = np.array(ours.quaternion)
  for _ in range(300):
    gyroscope = rng.normal(size=3)
    accelerometer = np.array([0.5, -0.3, 9.7]) + rng.normal(size=3)
    ours.update(gyroscope, accelerometer)
    attitude = theirs.updateIMU(attitude, gyr=gyroscope, acc=accelerometer)
  np.testing.assert_allclose(ours.quaternion, attitude, atol=1e-9)


def test_madgwick_starts_at_the_first_accelerometer_sample_and_follows_the_gyroscope():
  level = Madgwick()
  np.testing.assert_allclose(level.update(np.zeros(3), [0, 0, 9.81]), [0, 0, -1])
  up = np.array([0.6, 0.0, -0.8])
  np.testing.assert_allclose(Madgwick().update(np.zeros(3), up), -up, atol=1e-12)
  # Half a turn about x at 1 rad/s, accelerometer consistent: gravity goes round with it. The
  # gradient is taken at the previous attitude (Madgwick's equation 44), so that the estimate may
  # lead by one sample, 8 mrad here.
  for step in range(1, int(125 * np.pi) + 1):
    angle = step / 125
    gravity = level.update([1.0, 0.0, 0.0], [0.0, np.sin(angle), np.cos(angle)])
  expected = [0.0, -np.sin(angle), -np.cos(angle)]
  np.testing.assert_allclose(gravity, expected, atol=0.01)


def test_madgwick_upside_down_start():
  np.testing.assert_allclose(Madgwick().update(np.zeros(3), [0, 0, -9.81]), [0, 0, 1], atol=1e-9)


# RMS inclination error while moving, degrees, with the default beta at 125 Hz behind the chip's
# low-pass; measured 2.29 and 3.24.
@pytest.mark.parametrize(
  ("trial", "bound"),
  [("07_undisturbed_fast_rotation_B", 2.5), ("15_undisturbed_fast_translation_A", 3.5)],
)
def test_madgwick_against_measured_attitude(trial, bound):
  path = _IMU / f"{trial}.mat"
  if not path.exists():
    pytest.skip(f"{path} is not there")
  data = scipy.io.loadmat(path, squeeze_me=True)
  rate = float(data["sampling_rate"])
  raw = np.concatenate([data["imu_gyr"], data["imu_acc"]], axis=1)
  b, a = scipy.signal.butter(1, filters.CHIP_BANDWIDTH_HZ, fs=rate)
  start = scipy.signal.lfilter_zi(b, a)[:, None] * raw[0]
  smooth, _ = scipy.signal.lfilter(b, a, raw, axis=0, zi=start)
  chosen = np.round(np.arange(0, len(raw) / rate - 1 / 125, 1 / 125) * rate).astype(int)
  madgwick = Madgwick()
  estimate = np.array([madgwick.update(s[:3], s[3:]) for s in smooth[chosen]])
  w, x, y, z = data["opt_quat"][chosen].T
  up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
  error = np.rad2deg(np.arccos(np.clip(-(estimate * up).sum(1), -1, 1)))
  valid = ~np.isnan(error) & data["movement"][chosen].astype(bool)
  rms = float(np.sqrt(np.mean(error[valid] ** 2)))
  assert rms < bound
