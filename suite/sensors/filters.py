"""Filters of the sensor and action path: low-pass, range of the IMU chip, action smoothing.

They hold state, work on float arrays of a fixed shape and use nothing of the simulator: the same
objects run on the robot. Each has `reset()` and one call a sample.

The low-pass of the IMU chip: OP3's OpenCR board carries an MPU-9250 (later boards an ICM-20648).
Its firmware (ROBOTIS-GIT/OpenCR, libraries/IMU/MPU9250.cpp and ICM20648.cpp, `init`) turns on the
digital low-pass filter with the settings 41 Hz for gyroscope and accelerometer (51 and 50 Hz on the
ICM-20648). The data sheet gives bandwidth and delay only: gyroscope 41 Hz and 5.9 ms, 20 Hz and
9.9 ms, 10 Hz and 17.85 ms. These delays are those of a first-order low-pass at that bandwidth,
1 / (2 pi f), plus 1.9 to 2.0 ms at every setting. So the chip is modelled as a first-order low-pass
at the bandwidth (`CHIP_BANDWIDTH_HZ`) and a constant transport delay (`CHIP_DELAY`) that the delay
line may add.
"""

import numpy as np
from scipy import signal

Array = np.ndarray

CHIP_BANDWIDTH_HZ = 41.0  # OpenCR firmware, gyroscope and accelerometer of the MPU-9250
CHIP_DELAY = 0.002  # s, data-sheet delay minus that of a first-order low-pass; see above
# OpenCR firmware, `init` of both chips (FSR_2G, 2000DPS), and the scales of ROBOTIS-OP3's
# open_cr_module: 16-bit readings end at 2 g and, at 16.4 counts per degree/s, at 1998 degrees/s. A
# walking OP3 exceeds 2 g at every step.
CHIP_ACCELERATION = 2 * 9.80665  # m/s^2
CHIP_TURNING_RATE = 32767 / 16.4 * np.pi / 180  # rad/s
_CHIP_RANGE = np.repeat([CHIP_TURNING_RATE, CHIP_ACCELERATION], 3)
MIN_DELAY, MAX_DELAY = 0.010, 0.050  # s, paper, constant over an episode
JITTER = 0.005  # s, paper


class LowPass:
  """First-order digital Butterworth low-pass (bilinear, pre-warped) over an array of any shape.

  y[k] = b0 x[k] + b1 x[k-1] - a1 y[k-1]. The first sample after a reset is taken as the steady
  state, so that there is no start-up ramp from zero (an accelerometer reads 9.81 m/s^2 from the
  first sample on).
  """

  def __init__(self, cutoff_hz: float, sample_rate_hz: float):
    """Creates the filter.

    Args:
      cutoff_hz: Frequency at which the gain is 1/sqrt(2), Hz, below half the sample rate.
      sample_rate_hz: Rate of the calls, Hz.
    """
    if not 0 < cutoff_hz < sample_rate_hz / 2:
      raise ValueError(
        f"Found a cutoff of {cutoff_hz} Hz at {sample_rate_hz} Hz sampling, expected between 0 and"
        f" half the sampling rate, {sample_rate_hz / 2} Hz."
      )
    (self._b0, self._b1), (_, self._a1) = (
      values.tolist() for values in signal.butter(1, cutoff_hz, fs=sample_rate_hz)
    )
    self.reset()

  def reset(self) -> None:
    """Clears the state: the next sample is the new steady state."""
    self._state: Array | None = None

  def __call__(self, sample: Array) -> Array:
    """Returns the filtered sample, a new array of the same shape."""
    x = np.asarray(sample, np.float64)
    # Steady state of the transposed direct form II for a constant input and unit gain.
    state = (self._b1 - self._a1) * x if self._state is None else self._state
    y = self._b0 * x + state
    self._state = self._b1 * x - self._a1 * y
    return y


def saturate(imu: Array) -> Array:
  """Returns turning rates and specific force [6] [rad/s, m/s^2] as far as the chip's range goes."""
  return np.clip(imu, -_CHIP_RANGE, _CHIP_RANGE)


class ExponentialFilter:
  """Smooths actions: y = strength * y_previous + (1 - strength) * u, once a control step.

  The paper says "an exponential filter with strength 0.8 ... to encourage smoother movements". Read
  as 0.8 of the old value it smooths with a time constant of 112 ms at 40 Hz; the other reading (0.8
  of the new one) hardly smooths, 16 ms. The first is taken.
  """

  def __init__(self, strength: float):
    if not 0 <= strength < 1:
      raise ValueError(f"Found filter strength {strength}, expected at least 0 and less than 1.")
    self.strength = strength
    self.value: Array | None = None

  def reset(self, value: Array | None = None) -> None:
    """Starts from `value` (for instance the pose that the robot stands in), or the next action."""
    self.value = None if value is None else np.array(value, np.float64)

  def __call__(self, action: Array) -> Array:
    """Returns the smoothed action, a copy."""
    action = np.asarray(action, np.float64)
    if self.value is None:
      self.value = action.copy()
    else:
      self.value = self.strength * self.value + (1 - self.strength) * action
    return self.value.copy()
