"""The bus's own clock: every 8 ms the IMU and all joints are read, judged and recorded.

It runs in a thread of its own, so the robot is watched whatever the control loop does. When the
monitor demands a stop, torque goes off here, again and again until all servos confirm.
"""

import logging
import threading
from typing import Any

import numpy as np

from nerf2real.real.loop.sensing import Sensing
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.loop.timing import Timing
from nerf2real.real.safety.monitor import Monitor, Reason, Stop
from nerf2real.real.safety.operator import Operator
from nerf2real.real.wire.bus import Bus, JointReading
from nerf2real.real.wire.opencr import ImuReading
from nerf2real.real.wire.servos import Servos
from nerf2real.suite.op3 import constants

PERIOD = constants.BUS_PERIOD  # s
_SLACK = 0.0005  # s before the next cycle at which waiting for answers ends
_SLOW_EVERY = 125  # cycles between records of voltage and temperature
_log = logging.getLogger(__name__)


class Cycle:
  """Reads the robot periodically and switches the torque off when it must be."""

  def __init__(
    self,
    bus: Bus,
    servos: Servos,
    *,
    operator: Operator,
    timing: Timing,
    settings: RobotSettings,
    camera: bool,
    recorder: Any = None,
  ):
    """Starts reading.

    Args:
      bus: The bus.
      servos: The servos on it, set up.
      operator: Whose key stops the robot.
      timing: Takes how long things took.
      settings: Settings of the robot.
      camera: Whether pictures are expected.
      recorder: Takes everything that was read (`real.recorder.recorder.Recorder`), or None.
    """
    self.stop: Stop | None = None
    self.sensing = Sensing(low_pass=not settings.chip_low_pass)
    self._bus, self._servos, self._operator = bus, servos, operator
    self._monitor = Monitor(settings.safety, camera=camera)
    self._monitor.arm(bus.clock.now())
    self._timing, self._recorder, self._dry_run = timing, recorder, settings.dry_run
    self._commands = threading.Lock()  # a goal must not follow a stop
    self._torque_off = True
    self._count = 0
    self._job = bus.clock.every(PERIOD, self._guarded, name="robot bus")

  @property
  def missed(self) -> int:
    """Cycles that were not begun, because the one before still ran."""
    return self._job.missed

  @property
  def torque_off(self) -> bool:
    """Whether all servos have confirmed that their torque is off."""
    return self._torque_off

  def watch(self) -> None:
    """Begins to watch anew: everything counts as seen just now."""
    self._monitor.arm(self._bus.clock.now())

  def hold(self, held: bool) -> None:
    """Sets whether a person holds the robot, so that its tilt does not matter."""
    self._monitor.held = held

  def accepts(self, action: np.ndarray) -> bool:
    """Returns whether an action is fit to be sent; one that is not switches the torque off."""
    stop = self._monitor.action(self._bus.clock.now(), action)
    if stop is not None:
      self.halt(stop)
    return stop is None

  def take_picture(self, age: float | None) -> None:
    """Judges the age of the newest picture [s]; None if it was lost."""
    stop = self._monitor.camera(self._bus.clock.now(), age)
    if stop is not None:
      self.halt(stop)

  def energize(self) -> None:
    """Switches the torque on where the joints are.

    Raises:
      BusError: A servo refuses.
    """
    if self._dry_run:
      return
    counts = self._servos.prepare()  # without the lock: a stop must not wait for joints to rest
    with self._commands:
      if self.stop is None:
        self._torque_off = False
        self._servos.start(counts)

  def send(self, angles: np.ndarray) -> bool:
    """Sends goals [J] [rad] unless the robot was stopped; returns whether they were sent."""
    with self._commands:
      if self.stop is not None:
        return False
      if not self._dry_run:
        self._bus.write_goals(angles)
        self._monitor.goals = angles
    if self._recorder is not None:
      now = self._bus.clock.wall(self._bus.clock.now())
      self._recorder.command(now, constants.JOINT_NAMES, angles)
    return True

  def halt(self, stop: Stop) -> None:
    """Switches the torque off, for good until `rearm`."""
    with self._commands:
      if self.stop is not None:
        return
      self.stop = stop
      self._monitor.goals = None
      if not self._dry_run:
        self._torque_off = False
        self._bus.drop_torque()
    _log.error("torque off: %s (%s)", stop.reason, stop.detail)

  def relax(self) -> bool:
    """Switches the torque off as planned; returns whether all servos confirmed."""
    with self._commands:
      self._monitor.goals = None
      if not self._dry_run:
        self._torque_off = self._servos.torque(False)
    return self._torque_off

  def rearm(self) -> None:
    """Clears the stop. Without torque the robot lies or is held: its tilt does not matter yet."""
    with self._commands:
      self._monitor.arm(self._bus.clock.now())
      self._monitor.held = True
      self.stop = None

  def close(self) -> None:
    """Ends the reading."""
    self._job.stop()

  def _guarded(self) -> None:
    try:
      self._run()
    except Exception as error:
      # Whatever is wrong with this program, the robot must not stand under torque unwatched.
      _log.exception("the bus cycle failed")
      self.halt(Stop(Reason.FAILURE, f"{type(error).__name__}: {error}", self._bus.clock.now()))

  def _run(self) -> None:
    clock, bus = self._bus.clock, self._bus
    begin = clock.now()
    deadline = begin + PERIOD - _SLACK
    imu = bus.read_imu(deadline=deadline) or bus.read_imu(deadline=deadline)
    joints = bus.read_joints(deadline=deadline)
    now = clock.now()
    self._timing.add("bus cycle", now - begin)
    gravity = None
    if imu is not None:
      gravity = self.sensing.take_imu(imu)
    if joints is not None:
      self.sensing.take_joints(joints)
      self._timing.add("read skew", float(joints.stamps[-1] - joints.stamps[0]))
    if self.stop is None:
      self._judge(now, gravity, joints)
    elif not self._torque_off:
      self._insist()
    if self._recorder is not None:
      self._record(imu, gravity, joints)
    self._count += 1

  def _judge(self, now: float, gravity: np.ndarray | None, joints: JointReading | None) -> None:
    stop = self._monitor.joints(now, joints) or self._monitor.imu(now, gravity)
    if stop is None and self._operator.pressed():
      stop = Stop(Reason.OPERATOR, "a key was pressed", now)
    if stop is not None:
      self.halt(stop)

  def _insist(self) -> None:
    """Goes on switching the torque off until every servo confirms."""
    with self._commands:
      self._bus.drop_torque()
      states = self._servos.torque_states()
      self._torque_off = all(state == 0 for state in states)

  def _record(
    self, imu: ImuReading | None, gravity: np.ndarray | None, joints: JointReading | None
  ) -> None:
    recorder, wall = self._recorder, self._bus.clock.wall
    if imu is not None and gravity is not None:
      recorder.imu(wall(imu.stamp), imu.gyroscope, imu.accelerometer, gravity)
    if joints is not None:
      recorder.joints(
        wall(float(joints.stamps.mean())),
        constants.JOINT_NAMES,
        joints.positions,
        joints.velocities,
        joints.currents,
        joints.voltages,
        joints.pwm,
        stamps=np.array([wall(stamp) for stamp in joints.stamps]),
      )
    if self._count % _SLOW_EVERY == 0:
      if imu is not None:
        recorder.battery(wall(imu.stamp), imu.voltage)
      if joints is not None:
        moment = wall(float(joints.stamps.mean()))
        for name, degrees in zip(constants.JOINT_NAMES, joints.temperatures, strict=True):
          recorder.temperature(moment, name, float(degrees))
