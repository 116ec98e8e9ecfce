"""Slow moves with the robot held: up to its pose before an episode, and to rest at the end."""

import logging

import numpy as np

from nerf2real.real.clock import Clock
from nerf2real.real.loop.cycle import Cycle
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.safety.monitor import Limiter, Reason, SafetyError, Stop
from nerf2real.real.safety.operator import Operator
from nerf2real.real.wire.bus import BusError
from nerf2real.real.wire.servos import Servos
from nerf2real.suite.op3 import constants

SUPPORTED_POSE = constants.standing_targets()  # [J] rad, where the robot starts and ends, held
_LEVEL_TIME = 0.1  # s in which at least one of a dozen IMU readings arrives
_FIRST_READING = 2.0  # s to wait for the first reading of everything
_log = logging.getLogger(__name__)


class Motion:
  """Brings the robot to its pose and to rest, held by a person; starts again after a stop."""

  def __init__(
    self,
    cycle: Cycle,
    servos: Servos,
    limiter: Limiter,
    *,
    operator: Operator,
    clock: Clock,
    settings: RobotSettings,
  ):
    """Takes what moves and watches the robot; nothing moves."""
    self._cycle, self._servos, self._limiter = cycle, servos, limiter
    self._operator, self._clock = operator, clock
    self._settings = settings
    self.standing = False  # under torque, in the supported pose or beyond

  def stand(self) -> None:
    """Has the robot held, moves it slowly to its pose and lets it stand.

    Raises:
      SafetyError: It must not or does not get there; the message holds the reason.
    """
    self._clear_stop()
    self._wait_for_readings()
    self._take_hold()
    if not self.standing:
      self._energize()
    self._move_slowly(SUPPORTED_POSE)
    self._level()
    if not self._settings.dry_run:  # without torque it could not stand
      self._cycle.hold(False)
      self._operator.support(False)
      self._stand_still()
      self._level()

  def rest(self) -> bool:
    """Has the robot held, moves it slowly to its pose and switches the torque off.

    Returns:
      Whether all servos confirmed that.
    """
    if self.standing and self._cycle.stop is None:
      self._take_hold()
      self._move_slowly(SUPPORTED_POSE)
      self.standing = False
      return self._cycle.relax()
    return self._settings.dry_run or self._cycle.torque_off or self._servos.torque(False)

  def _stand_still(self) -> None:
    """Lets the robot settle on its feet, and measures the gyroscope's zero when it has."""
    settle = self._settings.settle_time
    rest = min(self._settings.rest_time, settle / 2)
    self._pause(settle - rest)
    self._cycle.sensing.begin_rest()
    self._pause(rest)
    if not self._cycle.sensing.end_rest():
      _log.warning("the robot did not stand still: the gyroscope's old zero is kept")

  def _take_hold(self) -> None:
    if not self._settings.dry_run:  # without torque it lies, hangs or sits where it is
      self._operator.support(True)
    self._cycle.hold(True)
    self._pause(self._settings.grip_time)

  def _energize(self) -> None:
    try:
      self._cycle.energize()
    except BusError as error:
      self._cycle.halt(Stop(Reason.BUS, str(error), self._clock.now()))
      raise SafetyError(f"Torque stays off: {error}") from error
    joints = self._cycle.sensing.joints
    assert joints is not None
    self._limiter.reset(joints.positions)
    self.standing = True

  def _move_slowly(self, pose: np.ndarray) -> None:
    """Moves the goals to a pose [J] [rad] at the slow speed."""
    start = self._limiter.goal
    assert start is not None
    speed, period = self._settings.safety.slow_speed, constants.CONTROL_TIMESTEP
    count = int(np.ceil(np.abs(pose - start).max() / (speed * period)))
    slow = Limiter(np.minimum(pose, start), np.maximum(pose, start), max_speed=speed)
    slow.reset(start)
    due = self._clock.now()
    for _ in range(count):
      self._cycle.send(slow(pose, period))
      due += period
      self._clock.sleep_until(due)
      self.raise_if_stopped()
    self._limiter.reset(pose)

  def _level(self) -> None:
    """Sets the gravity estimate from the accelerometer: the robot rests, and the filter is slow."""
    self._cycle.sensing.level()
    self._pause(_LEVEL_TIME)

  def _pause(self, seconds: float) -> None:
    self._clock.sleep_until(self._clock.now() + seconds)
    self.raise_if_stopped()

  def _wait_for_readings(self) -> None:
    end = self._clock.now() + _FIRST_READING
    while not self._cycle.sensing.ready:
      if self._clock.now() > end:
        raise SafetyError("Joints and IMU cannot be read: check the cables.")
      self._clock.sleep_until(self._clock.now() + constants.BUS_PERIOD)

  def _clear_stop(self) -> None:
    """Makes a new start possible after a stop, if its cause is gone."""
    if self._cycle.stop is None:
      return
    self.standing = False
    end = self._clock.now() + _FIRST_READING
    while not self._cycle.torque_off and self._clock.now() < end:
      self._clock.sleep_until(self._clock.now() + constants.BUS_PERIOD)
    errors_found = {} if self._settings.dry_run else self._servos.hardware_errors()
    if errors_found:
      raise SafetyError(
        f"These servos report errors: {errors_found}. Find the cause, then clear them with "
        "environment.servos.reboot(joint)."
      )
    if not self._settings.dry_run and not self._cycle.torque_off:
      silent = ", ".join(self._servos.silent()) or "none at the moment"
      raise SafetyError(
        f"Not every servo confirmed that its torque is off. Devices that do not answer: {silent}."
      )
    self._cycle.rearm()

  def raise_if_stopped(self) -> None:
    stop = self._cycle.stop
    if stop is not None:
      self.standing = False
      raise SafetyError(f"Torque was switched off: {stop.reason} ({stop.detail}).")
