"""From the bus's readings to a policy's observations: Madgwick, action filter's input, histories.

The same filters as in simulation (`suite.sensors.filters`, `suite.sensors.madgwick`), the same
names and shapes (`suite.specs`). The low-pass is in the IMU chip, as OP3's firmware sets it; a
board whose chip has it off gets the simulation's filter here. Nothing is delayed on purpose: the
delays are the robot's own.

A gyroscope's zero drifts: 0.013 rad/s that stay after the board's own zeroing tilt the estimate of
gravity by 12 degrees within 20 s of walking (Madgwick's step is 0.033 rad/s at most, and steps
shake the accelerometer). So the zero is measured while the robot stands still before an episode.
"""

import numpy as np

from nerf2real.real.wire.bus import JointReading
from nerf2real.real.wire.opencr import ImuReading
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.histories import Histories
from nerf2real.suite.sensors.madgwick import Madgwick

_LONG_GAP = 1.5  # periods after which a sample was missed
_STILL = 0.03  # rad/s, standard deviation of the turning rate of a robot that stands still: chosen
_MAX_ZERO = 0.1  # rad/s: a mean above it is a turn and no zero, whatever the deviation: chosen
_MIN_READINGS = 20  # of which a zero is the mean: chosen


class Sensing:
  """The newest readings, the direction of gravity, and the histories of a policy."""

  def __init__(self, *, low_pass: bool = False):
    """Starts empty.

    Args:
      low_pass: Whether to filter the IMU as the chip would.
    """
    rate = 1 / constants.BUS_PERIOD
    self._low_pass = filters.LowPass(filters.CHIP_BANDWIDTH_HZ, rate) if low_pass else None
    self._madgwick = Madgwick()
    self._imu: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    self._joints: JointReading | None = None
    self._zero = np.zeros(3)  # rad/s that the gyroscope reads at rest
    self._rest: list[np.ndarray] | None = None  # readings at rest, while they are collected
    self.histories = Histories()

  def take_imu(self, reading: ImuReading) -> np.ndarray:
    """Takes an IMU reading; returns the direction of gravity [3] in the torso."""
    gyroscope, accelerometer = reading.gyroscope, reading.accelerometer
    if self._low_pass is not None:
      values = self._low_pass(np.concatenate([gyroscope, accelerometer]))
      gyroscope, accelerometer = values[:3], values[3:]
    if self._rest is not None:
      self._rest.append(gyroscope)
    gyroscope = gyroscope - self._zero
    self._madgwick.period = constants.BUS_PERIOD
    if self._imu is not None:
      gap = reading.stamp - self._imu[0]
      if gap > _LONG_GAP * constants.BUS_PERIOD:  # readings were lost: this one stands for more
        self._madgwick.period = gap
    gravity = self._madgwick.update(gyroscope, accelerometer)
    self._imu = (reading.stamp, gyroscope, accelerometer, gravity)
    return gravity

  def take_joints(self, reading: JointReading) -> None:
    """Takes a reading of the joints."""
    self._joints = reading

  def level(self) -> None:
    """Lets the next IMU reading set the attitude anew; the robot is at rest then."""
    self._madgwick.reset()
    if self._low_pass is not None:
      self._low_pass.reset()

  def begin_rest(self) -> None:
    """Begins to collect the gyroscope's readings: the robot stands still from now on."""
    self._rest = []

  def end_rest(self) -> bool:
    """Takes the mean of what was collected as the gyroscope's zero.

    Returns:
      Whether it was taken; if the robot moved, or hardly anything was read, the old zero stays.
    """
    readings, self._rest = np.array(self._rest or np.zeros((0, 3))), None
    if len(readings) < _MIN_READINGS or readings.std(axis=0).max() > _STILL:
      return False
    zero = readings.mean(axis=0)
    if np.abs(zero).max() > _MAX_ZERO:
      return False
    self._zero = zero
    return True

  @property
  def zero(self) -> np.ndarray:
    """What the gyroscope reads at rest [3] [rad/s]; it is subtracted from every reading."""
    return self._zero.copy()

  @property
  def ready(self) -> bool:
    """Whether both have been read."""
    return self._imu is not None and self._joints is not None

  @property
  def joints(self) -> JointReading | None:
    """The newest reading of the joints."""
    return self._joints

  def ages(self, time: float) -> tuple[float, float]:
    """Returns how old [s] the newest IMU reading and the oldest joint of the newest are."""
    assert self._imu is not None and self._joints is not None
    return time - self._imu[0], time - float(self._joints.stamps.min())

  def start(self, control: np.ndarray) -> None:
    """Fills the histories with what is now and a control signal [J], normalised."""
    self.histories.fill(self._newest(control))

  def push(self, control: np.ndarray) -> None:
    """Moves the histories on by one control step, in which `control` [J] was applied."""
    self.histories.push(self._newest(control))

  def _newest(self, control: np.ndarray) -> dict[str, np.ndarray]:
    imu, joints = self._imu, self._joints
    assert imu is not None and joints is not None
    return {
      "gyroscope": imu[1],
      "accelerometer": imu[2],
      "gravity": imu[3],
      "joint_positions": joints.positions,
      "previous_control": control,
    }
