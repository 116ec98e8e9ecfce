"""A robot as a plant: an operator places it, one episode after another, and enters the outcome."""

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from nerf2real import real
from nerf2real.evaluation import episodes
from nerf2real.evaluation.plants import perturbations
from nerf2real.evaluation.plants.plant import TASKS, Sight, Trial
from nerf2real.evaluation.plants.robot_plant import RobotPlant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.camera.device import Controls
from nerf2real.real.clock import RealClock, prefer_this_thread
from nerf2real.real.loading import Connection
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.safety.operator import Terminal
from nerf2real.suite.op3 import constants
from nerf2real.suite.protocols import DEFAULT_GAIN, NavigationTrial

_VERDICTS = {"s": episodes.SUCCESS, "c": episodes.COLLISION, "f": episodes.FALL, "l": episodes.LOST}
_QUESTION = "What happened? [s]uccess, [c]ollision, [f]all, [l]ost, [r]epeat the episode: "


class RepeatError(Exception):
  """The operator chose to repeat the episode."""


class OperatedPlant(RobotPlant):
  """Episodes on a robot. Any key ends one; nobody measures its pose."""

  name = "robot"
  plant_id = "op3"

  def __init__(
    self,
    scene: Any,
    settings: EvaluationSettings,
    *,
    image_size: tuple[int, int] | None,
    record: Path | None = None,
    ask: Callable[[str], str] | None = None,
    say: Callable[[str], None] = print,
  ):
    """Connects to the robot; nothing moves yet.

    Args:
      scene: An opened bundle of the room.
      settings: The evaluation's: protocol, perturbation, time limit, where the robot is reached and
        what is its own. In a dry run nothing moves, and no verdict is asked for.
      image_size: Height and width of the policy's picture; None for no camera.
      record: Where the run is recorded; not recorded if None.
      ask: Puts a question to the operator and returns the answer; None: at this terminal.
      say: Shows the operator a line.
    """
    super().__init__(scene, settings, record=record)
    self._say, self._dry_run, self._steps = say, settings.dry_run, 0
    with contextlib.ExitStack() as undone:  # unless all succeeds
      undone.callback(self._abandon_recording)
      robot: Any = settings.robot
      connection = Connection(port=robot) if isinstance(robot, str) else robot
      own = {name: getattr(settings, name) for name in ("camera", "offsets", "lens")}
      given = {name: value for name, value in own.items() if value is not None}
      connection = dataclasses.replace(connection, **given)
      if ask is None:  # through the terminal that the stop key is read from, never beside it
        terminal = Terminal()
        connection = dataclasses.replace(connection, operator=terminal)
        ask = terminal.ask
      if connection.operator is not None:  # a terminal that was taken is given back
        undone.callback(connection.operator.close)
      self._ask = ask
      self._environment = real.load(
        TASKS[self.protocol],
        robot=connection,
        scene=scene,
        image_size=image_size,
        time_limit=settings.time_limit,
        settings=RobotSettings(dry_run=settings.dry_run),
        recorder=self._recorder,
      )
      undone.callback(self._environment.close)
      if isinstance(self._environment.bus.clock, RealClock):
        prefer_this_thread(acting=True)
      if scene.marker is not None:
        self._say(f"Places are on the scene's map. {scene.marker.words}")
      undone.pop_all()

  def start(self, trial: Trial) -> dm_env.TimeStep:
    pose, ball = self._places(trial)
    if isinstance(trial, NavigationTrial):
      self._say(f"Goal {trial.goal + 1} at x = {self.goal[0]:.2f} m, y = {self.goal[1]:.2f} m.")
      self._set_gain(trial.camera_gain * DEFAULT_GAIN)
    if ball is not None:
      self._say(f"Put the ball at x = {ball[0]:.2f} m, y = {ball[1]:.2f} m.")
    if self.perturbation in perturbations.INSTRUCTIONS:
      self._say(perturbations.INSTRUCTIONS[self.perturbation])
    self._ask(
      f"Place the robot at x = {pose.x:.2f} m, y = {pose.y:.2f} m, heading "
      f"{np.rad2deg(pose.yaw):.0f} degrees from the x axis; Enter when it is there: "
    )
    self._start_pose = pose
    self._steps = 0
    return self._environment.reset()

  def _set_gain(self, gain: float) -> None:
    camera: Any = self._environment.camera
    if not hasattr(camera, "set_controls"):
      return
    found = camera.set_controls(Controls(gain=gain))["gain"]
    if not found.holds:
      self._say(f"The camera does not take the gain {gain:g}, found {found.found}: set it by hand.")

  def step(self, action: np.ndarray) -> dm_env.TimeStep:
    self._steps += 1
    return self._environment.step(action)

  def sight(self) -> Sight:
    pose = self._start_pose if self._steps == 0 else None
    return Sight(pose, None, False, self._stopped_by_a_fall())

  def judge(self) -> tuple[str, float | None, str] | None:
    if self._dry_run:
      return episodes.STOPPED, None, f"dry run; {self._environment.timing.line()}"
    time = self._steps * constants.CONTROL_TIMESTEP
    while True:
      answer = self._ask(_QUESTION).strip().lower()[:1]
      if answer == "r":
        raise RepeatError
      if answer in _VERDICTS:
        break
      self._say("Expected one of the letters s, c, f, l, r.")
    outcome = _VERDICTS[answer]
    return outcome, time if outcome == episodes.SUCCESS else None, self.stopped()

  def close(self) -> None:
    try:
      self._environment.close()
    finally:
      if self._recorder is not None:
        with contextlib.suppress(OSError):
          self._recorder.close()
