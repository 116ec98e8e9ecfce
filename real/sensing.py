"""From the bus's readings to what a policy is told: Madgwick, action filter's input, histories.

The same filters as in simulation (`suite.filters`, `suite.madgwick`), the same names and shapes
(`suite.specs`). The low-pass is in the IMU chip, as OP3's firmware sets it; a board whose chip has
it off gets the simulation's filter here. Nothing is delayed on purpose: the delays are the robot's
own.
"""

import numpy as np

from real.bus import JointReading
from real.opencr import ImuReading
from suite import filters, specs
from suite.madgwick import Madgwick
from suite.op3 import constants

_LONG_GAP = 1.5  # periods after which a sample was missed


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
    self._histories = {
      name: np.zeros((specs.HISTORY, size), np.float32)
      for name, (size, _) in specs.PROPRIOCEPTION.items()
    }

  def take_imu(self, reading: ImuReading) -> np.ndarray:
    """Takes an IMU reading; returns the direction of gravity [3] in the torso."""
    gyroscope, accelerometer = reading.gyroscope, reading.accelerometer
    if self._low_pass is not None:
      values = self._low_pass(np.concatenate([gyroscope, accelerometer]))
      gyroscope, accelerometer = values[:3], values[3:]
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

  @property
  def ready(self) -> bool:
    """Whether both have been read."""
    return self._imu is not None and self._joints is not None

  @property
  def joints(self) -> JointReading | None:
    """The newest reading of the joints."""
    return self._joints

  @property
  def gravity(self) -> np.ndarray | None:
    """The newest estimate of the direction of gravity [3] in the torso."""
    return None if self._imu is None else self._imu[3]

  def ages(self, time: float) -> tuple[float, float]:
    """Returns how old [s] the newest IMU reading and the oldest joint of the newest are."""
    assert self._imu is not None and self._joints is not None
    return time - self._imu[0], time - float(self._joints.stamps.min())

  def start(self, control: np.ndarray) -> None:
    """Fills the histories with what is now and a control signal [J], normalised."""
    for name, value in self._newest(control).items():
      self._histories[name][:] = value

  def push(self, control: np.ndarray) -> None:
    """Moves the histories on by one control step, in which `control` [J] was applied."""
    for name, value in self._newest(control).items():
      history = self._histories[name]
      history[:-1] = history[1:]
      history[-1] = value

  def read(self, name: str) -> np.ndarray:
    """Returns a history [H, size], oldest first, float32."""
    return self._histories[name].copy()

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
