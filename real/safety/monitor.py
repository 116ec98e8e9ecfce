"""Limits, and the reasons to switch the torque off, in one place.

`Limiter` is the last thing that a goal passes before it goes to the servos. `Monitor` sees every
reading and demands a stop; whoever runs the bus then switches the torque off. J joints.
"""

import dataclasses
import enum
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.real.wire.bus import JointReading
from nerf2real.suite.op3 import constants


class Reason(enum.StrEnum):
  """Why the torque was switched off."""

  FALL = "fall"
  TEMPERATURE = "temperature"
  VOLTAGE = "low voltage"
  SERVO = "servo error"
  BUS = "lost bus"
  CAMERA = "lost camera"
  ACTION = "bad action"
  TRACKING = "joint does not follow"
  OPERATOR = "operator"
  FAILURE = "failure of the program"


class Stop(NamedTuple):
  """The torque was switched off."""

  reason: Reason
  detail: str
  time: float  # s


class SafetyError(RuntimeError):
  """The robot must not move; the message holds the reason and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SafetySettings:
  """Limits. Those without a source are chosen with room to ordinary walking."""

  min_upright: float = constants.MIN_UPRIGHT
  """Cosine of the tilt below which the robot falls, as in `suite`."""
  max_temperature: float = 70.0
  """degrees C; the servos themselves give up at 80."""
  min_voltage: float = 10.0
  """V; a 3-cell battery below it is empty, servos give up at 9.5."""
  voltage_time: float = 0.2
  """s that the voltage may be lower: a heavy step is a short dip."""
  bus_timeout: float = 0.1
  """s without a reading of all joints, or of the IMU."""
  camera_timeout: float = 0.5
  """s that the newest picture may be old."""
  max_speed: float = 10.0
  """rad/s of a goal: twice what a servo can do."""
  slow_speed: float = 0.5
  """rad/s of the moves to and from the supported pose."""
  max_following_error: float = 0.7
  """rad between goal and joint: more than a standing load bends."""
  following_time: float = 0.75
  """s that it may be larger."""


class Limiter:
  """Clips goals to the joints' limits and to a speed."""

  def __init__(self, lower: np.ndarray, upper: np.ndarray, *, max_speed: float):
    """Takes the limits [J] [rad] and the largest speed [rad/s]."""
    self._lower, self._upper, self._speed = lower.copy(), upper.copy(), max_speed
    self._goal: np.ndarray | None = None

  def reset(self, angles: np.ndarray) -> None:
    """Starts from where the joints are [J] [rad], be it outside the limits."""
    self._goal = np.array(angles, np.float64)

  @property
  def goal(self) -> np.ndarray | None:
    """The goal [J] [rad] that was given last."""
    return None if self._goal is None else self._goal.copy()

  def __call__(self, angles: np.ndarray, period: float) -> np.ndarray:
    """Returns what may be sent instead of a goal [J] [rad], a period [s] after the last one."""
    if self._goal is None:
      raise RuntimeError("The limiter does not know where the joints are: call reset first.")
    wanted = np.clip(angles, self._lower, self._upper)
    step = self._speed * period
    self._goal = np.clip(wanted, self._goal - step, self._goal + step)
    return self._goal.copy()


class Monitor:
  """Safety limits on readings, pictures and actions; times are the loop's clock [s]."""

  def __init__(self, settings: SafetySettings, *, camera: bool):
    """Starts unarmed.

    Args:
      settings: Limits.
      camera: Whether pictures are expected.
    """
    self._settings = settings
    self._camera_expected = camera
    self.held = True  # by a person: the tilt does not matter
    self.goals: np.ndarray | None = None  # [J] rad, what the joints should follow; None: nothing
    self.arm(0.0)

  def arm(self, time: float) -> None:
    """Begins to watch at a time: everything counts as seen just now."""
    self._joints_seen = self._imu_seen = self._camera_seen = time
    self._voltage_since: float | None = None
    self._following_since: float | None = None

  def joints(self, time: float, reading: JointReading | None) -> Stop | None:
    """Judges a reading of the joints; None if it was lost."""
    settings = self._settings
    if reading is None:
      return self._silent("joints", self._joints_seen, time)
    self._joints_seen = time
    if reading.alerts.any():
      return Stop(Reason.SERVO, f"reported by {_names(reading.alerts)}", time)
    hot = reading.temperatures > settings.max_temperature
    if hot.any():
      degrees = reading.temperatures.max()
      return Stop(Reason.TEMPERATURE, f"{_names(hot)}: {degrees:.0f} degrees C", time)
    low = self._low_voltage(float(np.median(reading.voltages)), time)
    return low or self._does_not_follow(reading.positions, time)

  def imu(self, time: float, gravity: np.ndarray | None) -> Stop | None:
    """Judges an estimate of the direction of gravity [3] in the torso; None if it was lost."""
    if gravity is None:
      return self._silent("IMU", self._imu_seen, time)
    self._imu_seen = time
    upright = -float(gravity[2])
    if not self.held and upright < self._settings.min_upright:
      degrees = np.rad2deg(np.arccos(np.clip(upright, -1, 1)))
      return Stop(Reason.FALL, f"tilted by {degrees:.0f} degrees", time)
    return None

  def camera(self, time: float, age: float | None) -> Stop | None:
    """Judges the age [s] of the newest picture; None if there is none."""
    if not self._camera_expected:
      return None
    limit = self._settings.camera_timeout
    if age is not None:
      self._camera_seen = max(self._camera_seen, time - age)
    if time - self._camera_seen > limit:
      return Stop(Reason.CAMERA, f"no picture for {time - self._camera_seen:.2f} s", time)
    return None

  def action(self, time: float, action: np.ndarray) -> Stop | None:
    """Judges an action."""
    if np.isfinite(action).all():
      return None
    return Stop(Reason.ACTION, f"{np.count_nonzero(~np.isfinite(action))} values not finite", time)

  def _silent(self, what: str, seen: float, time: float) -> Stop | None:
    if time - seen > self._settings.bus_timeout:
      return Stop(Reason.BUS, f"no answer from the {what} for {1e3 * (time - seen):.0f} ms", time)
    return None

  def _low_voltage(self, volts: float, time: float) -> Stop | None:
    if volts >= self._settings.min_voltage:
      self._voltage_since = None
      return None
    if self._voltage_since is None:
      self._voltage_since = time
    if time - self._voltage_since >= self._settings.voltage_time:
      return Stop(Reason.VOLTAGE, f"{volts:.1f} V", time)
    return None

  def _does_not_follow(self, angles: np.ndarray, time: float) -> Stop | None:
    if self.goals is None:
      self._following_since = None
      return None
    away = np.abs(self.goals - angles) > self._settings.max_following_error
    if not away.any():
      self._following_since = None
      return None
    if self._following_since is None:
      self._following_since = time
    if time - self._following_since >= self._settings.following_time:
      return Stop(Reason.TRACKING, _names(away), time)
    return None


def _names(chosen: Sequence[bool] | np.ndarray) -> str:
  names = [name for name, hit in zip(constants.JOINT_NAMES, chosen, strict=True) if hit]
  return ", ".join(names)
