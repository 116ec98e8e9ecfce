"""Gravity in the body frame from gyroscope and accelerometer: Madgwick's filter.

Madgwick, An efficient orientation filter for inertial and inertial/magnetic sensor arrays (2010),
the form without magnetometer: equations 12 (rate), 25 and 26 (objective and Jacobian for gravity),
42 to 44 (normalised gradient step). Plain floats: one update takes a few microseconds, and it runs
unchanged on the robot.
"""

import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray

# Step along the gradient: how fast the accelerometer corrects the gyroscope. Larger follows the
# accelerometer (also when the body accelerates), smaller the gyroscope (also its bias).
BETA = 0.033  # rad/s, Madgwick 2010, section 5: the best value for the IMU form
SAMPLE_RATE_HZ = 125.0  # paper: "filtered at 125Hz"


class Madgwick:
  """Estimates the direction of gravity in the sensor's frame.

  State: the quaternion (w, x, y, z) that takes earth-frame vectors (z up) into the sensor's frame
  (Madgwick's ^S_E q). The heading is not observable and drifts; gravity does not depend on it.
  """

  def __init__(self) -> None:
    """Creates the filter; `period` is the time between updates [s]."""
    self.period = 1 / SAMPLE_RATE_HZ
    self.quaternion = (1.0, 0.0, 0.0, 0.0)
    self._started = False

  def reset(self) -> None:
    """Starts again: the next accelerometer sample sets the attitude."""
    self._started = False

  def update(self, gyroscope: Sequence[float] | Array, accelerometer: Sequence[float] | Array):
    """Takes one sample and returns the direction of gravity in the sensor's frame.

    Args:
      gyroscope: angular velocity [3], rad/s.
      accelerometer: specific force [3], m/s^2 (+9.81 along z for a level sensor at rest); its
        length does not matter. A zero vector (free fall) is skipped.

    Returns:
      Unit vector [3] pointing down: (0, 0, -1) for a level sensor.
    """
    ax, ay, az = float(accelerometer[0]), float(accelerometer[1]), float(accelerometer[2])
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if norm > 0:
      ax, ay, az = ax / norm, ay / norm, az / norm
      if not self._started:
        self.quaternion = _level(ax, ay, az)
        self._started = True
        return self.gravity()
    q0, q1, q2, q3 = self.quaternion
    gx, gy, gz = float(gyroscope[0]), float(gyroscope[1]), float(gyroscope[2])
    # Equation 12: rate of change of the attitude, q * (0, w) / 2.
    d0 = 0.5 * (-q1 * gx - q2 * gy - q3 * gz)
    d1 = 0.5 * (q0 * gx + q2 * gz - q3 * gy)
    d2 = 0.5 * (q0 * gy - q1 * gz + q3 * gx)
    d3 = 0.5 * (q0 * gz + q1 * gy - q2 * gx)
    if norm > 0:
      # Equations 25 and 26: predicted minus measured direction of the specific force, J^T f.
      f0 = 2 * (q1 * q3 - q0 * q2) - ax
      f1 = 2 * (q0 * q1 + q2 * q3) - ay
      f2 = 2 * (0.5 - q1 * q1 - q2 * q2) - az
      s0 = -2 * q2 * f0 + 2 * q1 * f1
      s1 = 2 * q3 * f0 + 2 * q0 * f1 - 4 * q1 * f2
      s2 = -2 * q0 * f0 + 2 * q3 * f1 - 4 * q2 * f2
      s3 = 2 * q1 * f0 + 2 * q2 * f1
      length = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2 + s3 * s3)
      if length > 0:
        step = BETA / length
        d0, d1, d2, d3 = d0 - step * s0, d1 - step * s1, d2 - step * s2, d3 - step * s3
    q0, q1, q2, q3 = (
      q0 + d0 * self.period,
      q1 + d1 * self.period,
      q2 + d2 * self.period,
      q3 + d3 * self.period,
    )
    length = math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    self.quaternion = (q0 / length, q1 / length, q2 / length, q3 / length)
    return self.gravity()

  def gravity(self) -> Array:
    """Returns the present estimate: unit vector [3] pointing down, in the sensor's frame."""
    q0, q1, q2, q3 = self.quaternion
    return np.array(
      [-2 * (q1 * q3 - q0 * q2), -2 * (q0 * q1 + q2 * q3), -2 * (0.5 - q1 * q1 - q2 * q2)]
    )


def _level(ax: float, ay: float, az: float) -> tuple[float, float, float, float]:
  """Returns the attitude, without turn about the vertical, in which the specific force is a."""
  if az < -1 + 1e-9:
    return (0.0, 1.0, 0.0, 0.0)
  # Smallest rotation: half-way quaternion between the vertical and the measured direction.
  w = math.sqrt((1 + az) / 2)
  return (w, ay / (2 * w), -ax / (2 * w), 0.0)
