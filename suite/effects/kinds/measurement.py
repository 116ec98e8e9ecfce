"""What differs between the state and what is measured of it: clocks, delays, the IMU.

Channels: "joint_positions", "joint_velocities" ([J] in the binding's order), "gyroscope",
"accelerometer" ([3], sensor frame), "camera" (see `camera`).
"""

import math

import numpy as np

from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.suite.effects.binding import Binding
from nerf2real.suite.effects.effect import Array, Kind, Operator, Parameter
from nerf2real.suite.sensors.delays import History

_JOINT_CHANNELS = ("joint_positions", "joint_velocities")
_IMU_CHANNELS = ("gyroscope", "accelerometer")
_CAPACITY = 512  # samples kept for delays


class MeasurementDelay(Operator):
  """Joint positions and velocities are reported `delay` seconds late.

  A late reading between two samples of the channel is interpolated: the encoder moves smoothly.
  """

  def bind(self, binding: Binding) -> None:
    delay = self.per_joint(binding)["delay"]
    self._groups = [(float(d), np.flatnonzero(delay == d)) for d in np.unique(delay) if d > 0]
    self._histories: dict[str, History] = {}

  def reset(self) -> None:
    for history in self._histories.values():
      history.clear()

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel not in _JOINT_CHANNELS or not self._groups:
      return value
    history = self._histories.setdefault(channel, History(_CAPACITY))
    history.push(time, np.asarray(value, np.float64))
    late = np.array(value, np.float64)
    for delay, joints in self._groups:
      late[joints] = history.interpolate(time - delay)[joints]
    return late


class ClockDrift(Operator):
  """The clock that stamps the measurements runs fast by `rate`: stamp = time * (1 + rate)."""

  def bind(self, binding: Binding) -> None:
    self._rate = sum(self.value(effect, "rate") for effect in self.effects)

  def stamp(self, time: float) -> float:
    return time * (1 + self._rate)


class ImuBias(Operator):
  """Gyroscope and accelerometer read too much by constants."""

  def bind(self, binding: Binding) -> None:
    self._bias = {
      channel: np.array(
        [sum(self.value(e, f"{channel}_{axis}") for e in self.effects) for axis in "xyz"]
      )
      for channel in _IMU_CHANNELS
    }

  def observe(self, channel: str, value: Array, time: float) -> Array:
    return value + self._bias[channel] if channel in _IMU_CHANNELS else value


class ImuTilt(Operator):
  """The IMU is mounted turned by the rotation vector (x, y, z): it measures R^T of the nominal."""

  def bind(self, binding: Binding) -> None:
    total = np.eye(3)
    for effect in self.effects:
      total = total @ matrix_from_rotvec([self.value(effect, axis) for axis in "xyz"])
    self._transpose = None if np.array_equal(total, np.eye(3)) else total.T

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel not in _IMU_CHANNELS or self._transpose is None:
      return value
    return self._transpose @ value


class ImuScale(Operator):
  """Gyroscope and accelerometer read in a wrong scale."""

  def bind(self, binding: Binding) -> None:
    self._scale = {
      channel: math.prod(self.value(e, channel) for e in self.effects) for channel in _IMU_CHANNELS
    }

  def observe(self, channel: str, value: Array, time: float) -> Array:
    return value * self._scale[channel] if channel in _IMU_CHANNELS else value


class ImuLag(Operator):
  """The IMU is late: a pure delay, then a first-order lag."""

  def bind(self, binding: Binding) -> None:
    self._delay = sum(self.value(effect, "delay") for effect in self.effects)
    self._lag = sum(self.value(effect, "time_constant") for effect in self.effects)
    self._histories = {channel: History(_CAPACITY) for channel in _IMU_CHANNELS}
    self.reset()

  def reset(self) -> None:
    self._state: dict[str, tuple[float, Array]] = {}
    for history in self._histories.values():
      history.clear()

  def observe(self, channel: str, value: Array, time: float) -> Array:
    if channel not in _IMU_CHANNELS:
      return value
    if self._delay > 0:
      self._histories[channel].push(time, np.asarray(value, np.float64))
      value = self._histories[channel].interpolate(time - self._delay)
    if self._lag > 0:
      if channel in self._state:
        before, state = self._state[channel]
        # Exact response of the lag to an input held at `value` since the last sample.
        value = value + math.exp(-(time - before) / self._lag) * (state - value)
      self._state[channel] = (time, np.array(value, np.float64))
    return value


def _axes(channel: str, unit: str, bound: float) -> tuple[Parameter, ...]:
  doc = "reading minus truth along "
  return tuple(
    Parameter(f"{channel}_{axis}", unit, 0.0, -bound, bound, f"{doc}{axis}", of_joint=False)
    for axis in "xyz"
  )


KINDS = (
  Kind(
    "measurement_delay",
    "joint positions and velocities are reported late",
    "joint",
    "measurement",
    (Parameter("delay", "s", 0.0, 0.0, 0.1, "latency", minimum=0.0, maximum=2.0),),
    MeasurementDelay,
  ),
  Kind(
    "clock_drift",
    "the clock of the measurements runs fast",
    "none",
    "measurement",
    (Parameter("rate", "1", 0.0, -0.02, 0.02, "seconds gained per second", minimum=-0.5),),
    ClockDrift,
  ),
  Kind(
    "imu_tilt",
    "the IMU is mounted turned",
    "none",
    "measurement",
    tuple(
      Parameter(a, "rad", 0.0, -0.2, 0.2, f"turn about its {a} axis", of_joint=False) for a in "xyz"
    ),
    ImuTilt,
  ),
  Kind(
    "imu_scale",
    "the IMU reads in a wrong scale",
    "none",
    "measurement",
    (
      Parameter("gyroscope", "1", 1.0, 0.8, 1.2, "reading over truth"),
      Parameter("accelerometer", "1", 1.0, 0.8, 1.2, "reading over truth"),
    ),
    ImuScale,
  ),
  Kind(
    "imu_bias",
    "the IMU reads too much by a constant",
    "none",
    "measurement",
    (*_axes("gyroscope", "rad/s", 0.2), *_axes("accelerometer", "m/s^2", 1.0)),
    ImuBias,
  ),
  Kind(
    "imu_lag",
    "the IMU is late",
    "none",
    "measurement",
    (
      Parameter("delay", "s", 0.0, 0.0, 0.1, "latency", minimum=0.0, maximum=2.0),
      Parameter("time_constant", "s", 0.0, 0.0, 0.1, "of the first-order lag", minimum=0.0),
    ),
    ImuLag,
  ),
)
