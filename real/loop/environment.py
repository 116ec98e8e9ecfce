"""The robot as a `dm_env.Environment` with the policy's observations and actions of `suite`.

A control step: the action goes through the action filter and the limits to the servos at once; the
step ends 25 ms after the last one ended, and what it returns is what the bus and the camera gave by
then. The time a policy needs is therefore part of the robot's delay, as everything else is.
"""

import collections
import contextlib
import logging
import threading
from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from nerf2real.core import errors
from nerf2real.real.camera.source import CameraSource
from nerf2real.real.loop.cycle import Cycle
from nerf2real.real.loop.motion import SUPPORTED_POSE, Motion
from nerf2real.real.loop.pictures import Pictures
from nerf2real.real.loop.settings import RobotSettings, TaskSpec
from nerf2real.real.loop.timing import Timing
from nerf2real.real.safety.monitor import Limiter, Reason, SafetyError, Stop
from nerf2real.real.safety.operator import Operator
from nerf2real.real.wire.bus import Bus
from nerf2real.real.wire.servos import Servos
from nerf2real.suite import specs as policy_specs
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters

_log = logging.getLogger(__name__)


class RobotEnvironment(dm_env.Environment):
  """An OP3 on its bus; see `real.load`. Close it: that ends slowly, in the supported pose."""

  def __init__(
    self,
    bus: Bus,
    task: TaskSpec,
    *,
    operator: Operator,
    camera: CameraSource | None = None,
    settings: RobotSettings | None = None,
    recorder: Any = None,
  ):
    """Switches the supply on, sets the servos up and begins to read; nothing moves.

    Where an earlier program has left the torque on, the robot is held before it is switched off.

    Args:
      bus: The open bus.
      task: What is observed, and for how long.
      operator: Who holds the robot and may stop it.
      camera: Source of pictures; None for a robot without.
      settings: Settings of the robot.
      recorder: A `real.recorder.recorder.Recorder`, or None.

    Raises:
      BusError: A device is missing or cannot be set up.
      SafetyError: A key was pressed instead of holding a robot under torque.
      ValueError: A camera without image_size, or the other way round.
    """
    image_size = task.image_size
    if (camera is None) != (image_size is None):
      raise ValueError(
        "A camera and an image_size belong together: give both, or image_size=None and no camera."
      )
    self.settings = settings or RobotSettings()
    self.goals = np.asarray(task.goals, np.float64).reshape(-1, 2)
    self.timing = Timing()
    self.dry_run = self.settings.dry_run
    self._bus, self._clock = bus, bus.clock
    self._operator = operator
    self._time_limit = task.time_limit
    self._lower, self._upper = constants.joint_limits(head_pan=task.head_pan_limit)
    self._middle = (self._lower + self._upper) / 2
    self._half_range = (self._upper - self._lower) / 2
    self._limiter = Limiter(self._lower, self._upper, max_speed=self.settings.safety.max_speed)
    self._action_filter = filters.ExponentialFilter(constants.ACTION_FILTER)
    self._pictures: Pictures | None = None
    if camera is not None and image_size is not None:
      self._pictures = Pictures(
        camera,
        image_size,
        clock=self._clock,
        timing=self.timing,
        recorder=recorder,
      )
    self._action_spec = policy_specs.action_spec()
    self._observation_spec = policy_specs.policy_observation_spec(
      goal_lower=task.goal_lower,
      goal_upper=task.goal_upper,
      image_shape=None if image_size is None else (*image_size, 3),
    )
    self.set_goal(self.goals[0])
    self._control = self._normalised(SUPPORTED_POSE)
    self._running = False  # an episode is
    self._closed = False
    self.servos = Servos(bus)
    self.servos.power_on()
    if not self.dry_run:
      if any(self.servos.torque_states()):  # a program died: without torque the robot would fall
        self._take_over()
      self.servos.set_up()
    self._cycle = Cycle(
      bus,
      self.servos,
      operator=operator,
      timing=self.timing,
      settings=self.settings,
      camera=camera is not None,
      recorder=recorder,
    )
    self._motion = Motion(
      self._cycle,
      self.servos,
      self._limiter,
      operator=operator,
      clock=self._clock,
      settings=self.settings,
    )

  def _take_over(self) -> None:
    """Has the robot held under the torque that a program has left; a key drops it at once."""
    stopped = threading.Event()

    def look() -> None:
      if self._operator.pressed():
        self._bus.drop_torque()
        stopped.set()

    watch = self._clock.every(constants.BUS_PERIOD, look, name="operator")
    try:
      self._operator.support(True)
    finally:
      watch.stop()
      look()
    if stopped.is_set():
      self.servos.torque(False)
      raise SafetyError(f"Torque was switched off: {Reason.OPERATOR} (a key was pressed).")

  # ---- dm_env ----

  def action_spec(self) -> specs.BoundedArray:
    """Returns the specification of an action: that of `suite`."""
    return self._action_spec

  def observation_spec(self) -> "collections.OrderedDict[str, specs.Array]":
    """Returns the specifications of the policy's observations: those of `suite`."""
    return self._observation_spec.copy()

  def reset(self) -> dm_env.TimeStep:
    """Has the robot held, moves it slowly to its pose, lets it stand, and starts an episode.

    Raises:
      SafetyError: The robot must not or does not get there; the message holds the reason.
    """
    self._check_open()
    self._running = False
    self._motion.stand()
    self._control = self._normalised(SUPPORTED_POSE)
    self._action_filter.reset(self._control)
    self.timing.reset()
    self._missed_before = self._cycle.missed
    now = self._clock.now()
    self._cycle.watch()
    self._cycle.sensing.start(self._control)
    self._start, self._steps, self._due = now, 0, now
    self._running = True
    return dm_env.restart(self._observe())

  def step(self, action: Any) -> dm_env.TimeStep:
    """Takes one control step; the first one after an episode's end starts the next.

    Raises:
      ValueError: The action has another shape than the specification.
    """
    self._check_open()
    if not self._running:
      return self.reset()
    action = np.asarray(action, np.float64)
    if action.shape != self._action_spec.shape:
      raise ValueError(errors.bad_action(action, self._action_spec))
    asked = self._clock.now()
    self.timing.add("policy", asked - self._due)
    if self._cycle.accepts(action):
      self._act(action, asked)
    self._wait_for_tick()
    self._cycle.sensing.push(self._control)
    observation = self._observe()
    self._steps += 1
    stop = self._cycle.stop
    if stop is not None:
      return self._end(dm_env.termination(reward=0.0, observation=observation))
    if self._steps >= self._time_limit / constants.CONTROL_TIMESTEP - 0.5:  # to the nearest step
      return self._end(dm_env.truncation(reward=0.0, observation=observation))
    return dm_env.transition(reward=0.0, observation=observation)

  def close(self) -> None:
    """Has the robot held, moves it slowly to its pose, switches the torque off, ends everything.

    What raises is raised when all the rest has ended.
    """
    if self._closed:
      return
    self._closed = True
    self._running = False
    relaxed = False

    def switch_off() -> None:
      if not relaxed and not self.dry_run and not self.servos.torque(False):
        _log.error("not every servo confirmed that its torque is off: switch the robot off")

    with contextlib.ExitStack() as endings:  # from the last one to the first
      if self._pictures is not None:
        endings.callback(self._pictures.close)
      endings.callback(self._operator.close)
      endings.callback(self._bus.close)
      endings.callback(switch_off)
      endings.callback(self._cycle.close)
      relaxed = self._motion.rest()

  # ---- beyond dm_env ----

  @property
  def goal(self) -> np.ndarray:
    """The goal that the policy sees [2] [m]."""
    return self._goal.copy()

  def set_goal(self, goal: np.ndarray | int) -> None:
    """Sets the goal: an index into `goals`, or a place [2] [m] in the scene's world frame."""
    if isinstance(goal, int | np.integer):
      if not 0 <= goal < len(self.goals):
        raise ValueError(f"Unknown goal {goal}: the scene has {len(self.goals)}, counted from 0.")
      goal = self.goals[goal]
    self._goal = np.asarray(goal, np.float64).reshape(2)

  @property
  def time_limit(self) -> float:
    """Length of an episode [s]."""
    return self._time_limit

  @property
  def standing_action(self) -> np.ndarray:
    """The action [J] that holds the supported pose."""
    return self._normalised(SUPPORTED_POSE).astype(np.float32)

  @property
  def stop(self) -> Stop | None:
    """Why the torque is off, if it was switched off."""
    return self._cycle.stop

  @property
  def missed_bus_cycles(self) -> int:
    """How many cycles of the bus were not begun, because the one before still ran."""
    return self._cycle.missed

  @property
  def bus(self) -> Bus:
    """The bus."""
    return self._bus

  @property
  def camera(self) -> CameraSource | None:
    """Where the pictures come from; None without a camera."""
    return None if self._pictures is None else self._pictures.camera

  # ---- acting ----

  def _act(self, action: np.ndarray, asked: float) -> None:
    self._control = self._action_filter(np.clip(action, -1.0, 1.0))
    goal = self._middle + self._half_range * self._control
    if self._cycle.send(self._limiter(goal, constants.CONTROL_TIMESTEP)):
      sent = self._clock.now()
      self.timing.add("sending", sent - asked)
      self.timing.add("observation to goal", sent - self._due)
      if sent > self._due + constants.CONTROL_TIMESTEP:
        self.timing.count("missed control deadlines")

  def _wait_for_tick(self) -> None:
    """Waits for the end of the control step; late steps are not made up for."""
    self._due += constants.CONTROL_TIMESTEP
    now = self._clock.now()
    if now > self._due:
      skipped = int((now - self._due) / constants.CONTROL_TIMESTEP)
      self._due += skipped * constants.CONTROL_TIMESTEP
    self._clock.sleep_until(self._due)
    self.timing.add("tick lateness", self._clock.now() - self._due)

  def _observe(self) -> "collections.OrderedDict[str, np.ndarray]":
    sensing, now = self._cycle.sensing, self._clock.now()
    imu_age, joint_age = sensing.ages(now)
    self.timing.add("imu age", imu_age)
    self.timing.add("joint age", joint_age)
    found = collections.OrderedDict(
      (name, sensing.histories.read(name)) for name in policy_specs.PROPRIOCEPTION
    )
    found["goal"] = self._goal.astype(np.float32)
    if self._pictures is not None:
      found["camera"], age = self._pictures.read()
      if self._running:
        self._cycle.take_picture(age)
    return found

  def _end(self, timestep: dm_env.TimeStep) -> dm_env.TimeStep:
    self._running = False
    if self._cycle.missed > self._missed_before:
      self.timing.count("missed bus cycles", self._cycle.missed - self._missed_before)
    stop = self._cycle.stop
    ending = "time limit" if stop is None else f"{stop.reason} ({stop.detail})"
    _log.info("episode of %d steps, ended by %s; %s", self._steps, ending, self.timing.line())
    if stop is not None:
      self._motion.standing = False
    return timestep

  def _check_open(self) -> None:
    if self._closed:
      raise RuntimeError("This environment is closed: make a new one with real.load.")

  def _normalised(self, angles: np.ndarray) -> np.ndarray:
    return (angles - self._middle) / self._half_range
