"""The path from the robot's true motion to its policy's observations.

Gyroscope and accelerometer pass the IMU chip's low-pass, end at its range, are sampled with the
encoders at 125 Hz, feed Madgwick's filter, and reach the policy late (a delay drawn for each
episode, and jitter). Each reading has a history of five control steps, oldest first. Shapes: J
joints, S physics steps in a control step, H history.
"""

from collections.abc import Callable

import numpy as np

from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.delays import DelayLine
from nerf2real.suite.sensors.histories import Histories
from nerf2real.suite.sensors.madgwick import Madgwick

_EPSILON = 1e-9  # s, against rounding in sums of time steps


class Proprioception:
  """Encoders, gyroscope, accelerometer and the estimate of gravity, with a history."""

  def __init__(self, *, physics_timestep: float, substeps: int):
    """Allocates the buffers.

    Args:
      physics_timestep: s.
      substeps: Physics steps in a control step.
    """
    self._timestep, self._substeps = physics_timestep, substeps
    self._low_pass = filters.LowPass(filters.CHIP_BANDWIDTH_HZ, 1 / physics_timestep)
    self._madgwick = Madgwick()
    self._imu_line, self._joint_line = DelayLine(), DelayLine()
    # Row 0 holds the last values of the previous control step: ticks fall between physics steps.
    self._imu = np.zeros((substeps + 1, 6))
    self._joints = np.zeros((substeps + 1, len(constants.JOINT_NAMES)))
    self.histories = Histories()
    self._step = 0
    self._tick = 0
    self.observe: Callable[[str, np.ndarray, float], np.ndarray] | None = None
    """What a reading becomes on the way: (channel, true value, time [s]); see suite.effects."""

  def reset(
    self,
    imu: np.ndarray,
    joints: np.ndarray,
    control: np.ndarray,
    *,
    imu_delay: float,
    joint_delay: float,
    jitter: float,
    rng: np.random.Generator,
  ) -> None:
    """Starts an episode in which the robot has been as it is now for a long time.

    Args:
      imu: Angular velocity [rad/s] and specific force [m/s^2] in the IMU's frame [6].
      joints: True joint positions [J] [rad].
      control: The present control signal [J], normalised.
      imu_delay: Delay of gyroscope, accelerometer and gravity [s].
      joint_delay: Delay of the encoders [s].
      jitter: Half width of the uniform jitter of each sample [s].
      rng: Source of the jitter.
    """
    self._low_pass.reset()
    self._madgwick.reset()
    delay = imu_delay + filters.CHIP_DELAY
    self._imu_line.reset(delay, jitter=jitter, rng=rng)
    self._joint_line.reset(joint_delay, jitter=jitter, rng=rng)
    self._imu[0], self._joints[0] = self._low_pass(imu), joints
    self._step, self._tick = 0, 0
    self._sample(self._imu[0], self._joints[0])
    self.histories.fill(self._newest(0.0, control))

  def record(self, substep: int, imu: np.ndarray, joints: np.ndarray) -> None:
    """Notes the true values at the end of a physics step (0 to S-1) of this control step."""
    self._imu[substep + 1] = imu
    self._joints[substep + 1] = joints

  def finish_step(self, control: np.ndarray) -> None:
    """Samples, filters and delays what was recorded, and moves the histories on by one.

    Args:
      control: The control signal that was applied in this control step [J], normalised.
    """
    start = self._step * self._timestep * self._substeps
    for row in range(1, self._substeps + 1):
      self._imu[row] = self._low_pass(self._imu[row])
    self._step += 1
    end = self._step * self._timestep * self._substeps
    while (self._tick * constants.BUS_PERIOD) <= end + _EPSILON:
      position = (self._tick * constants.BUS_PERIOD - start) / self._timestep
      row = min(int(position + _EPSILON), self._substeps - 1)
      weight = position - row
      self._sample(
        (1 - weight) * self._imu[row] + weight * self._imu[row + 1],
        (1 - weight) * self._joints[row] + weight * self._joints[row + 1],
      )
    self._imu[0], self._joints[0] = self._imu[-1], self._joints[-1]
    self.histories.push(self._newest(end, control))

  def _sample(self, imu: np.ndarray, joints: np.ndarray) -> None:
    """Takes the sample of one 125 Hz tick."""
    time = self._tick * constants.BUS_PERIOD
    if self.observe is not None:
      joints = self.observe("joint_positions", joints, time)
      gyroscope = self.observe("gyroscope", imu[:3], time)
      imu = np.concatenate([gyroscope, self.observe("accelerometer", imu[3:], time)])
    imu = filters.saturate(imu)
    gravity = self._madgwick.update(imu[:3], imu[3:])
    self._imu_line.push(time, np.concatenate([imu, gravity]))
    self._joint_line.push(time, np.rint(joints / constants.ENCODER_STEP) * constants.ENCODER_STEP)
    self._tick += 1

  def _newest(self, time: float, control: np.ndarray) -> dict[str, np.ndarray]:
    imu = self._imu_line.read(time)
    return {
      "gyroscope": imu[:3],
      "accelerometer": imu[3:6],
      "gravity": imu[6:],
      "joint_positions": self._joint_line.read(time),
      "previous_control": control,
    }
