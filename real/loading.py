"""Builds the environment of a robot from a task's name, as `suite.loading` does in simulation."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core import errors
from nerf2real.core.geometry.camera_info import read_camera_info
from nerf2real.real.camera.source import CameraSource, check_shape
from nerf2real.real.clock import Clock
from nerf2real.real.loop.environment import RobotEnvironment
from nerf2real.real.loop.settings import RobotSettings, TaskSpec
from nerf2real.real.safety.operator import Operator, Terminal
from nerf2real.real.wire import op3
from nerf2real.real.wire.bus import Bus
from nerf2real.suite.op3 import constants
from nerf2real.suite.scene import open_scene
from nerf2real.suite.tasks import catalogue
from nerf2real.suite.tasks.workspace import find_workspace


@dataclasses.dataclass(frozen=True, kw_only=True)
class Connection:
  """Where a robot is reached, and what is its own."""

  port: str
  """Path of the serial port."""
  camera: Any = None
  """Device number, file or URL for `real.camera.device`, or a `CameraSource`."""
  offsets: Path | str | None = None
  """The robot's `offset.yaml`; none if None."""
  lens: Path | str | None = None
  """The camera's camera_info YAML (`launch/calibrate_camera.py`), for the recording: without it the
  camera cannot be identified from the log."""
  operator: Operator | None = None
  """A person at this terminal if None."""
  clock: Clock | None = None
  """The machine's if None."""


def load(
  task: str,
  *,
  robot: str | Connection,
  scene: Any = None,
  image_size: tuple[int, int] | None = (30, 40),
  goal: int | np.ndarray = 0,
  time_limit: float | None = None,
  settings: RobotSettings | None = None,
  recorder: Any = None,
) -> RobotEnvironment:
  """Loads a task on a robot. Observations and actions are those of `suite.load`.

  Args:
    task: "nerf_nav" or "ball_push".
    robot: A connection, or the serial port of a robot without a camera, such as "/dev/ttyUSB0".
    scene: Folder of a scene bundle, or an opened one, for its goals and extent; None: the built-in
      room.
    image_size: (height, width) of the picture; None for a robot without a camera.
    goal: Index of one of the scene's goals, or a place [2] [m]; `set_goal` changes it.
    time_limit: Length of an episode [s]; the task's own if None.
    settings: Settings of the robot.
    recorder: A `real.recorder.recorder.Recorder`, which the caller closes.

  Returns:
    The environment. Nothing has moved; `reset` does.

  Raises:
    ValueError: An argument is none of what is expected.
    BusError: A device does not answer or cannot be set up.
    PortError: The serial port cannot be used.
    SafetyError: A key was pressed when it asked to hold a robot that stood under torque.
  """
  connection = Connection(port=robot) if isinstance(robot, str) else robot
  settings = settings or RobotSettings()
  spec = _task_spec(task, scene, image_size=image_size, time_limit=time_limit)
  lens = None if connection.lens is None else read_camera_info(Path(connection.lens))
  wiring = op3.Wiring() if connection.offsets is None else op3.read_offsets(connection.offsets)
  bus = Bus(connection.port, settings=settings.bus, wiring=wiring, clock=connection.clock)
  camera: CameraSource | None = None
  operator: Operator | None = None
  environment: RobotEnvironment | None = None
  try:
    if image_size is not None:
      camera = _open_camera(connection.camera, image_size)
    operator = connection.operator or Terminal()
    environment = RobotEnvironment(
      bus, spec, operator=operator, camera=camera, settings=settings, recorder=recorder
    )
    environment.set_goal(goal)
    if recorder is not None and lens is not None:
      recorder.camera_info(bus.clock.wall(bus.clock.now()), lens)
  except BaseException:
    if environment is not None:  # it reads already, and closes what it was given
      environment.close()
      raise
    bus.close()
    for opened in (camera, operator):
      if opened is not None:
        opened.close()
    raise
  return environment


def _task_spec(
  task: str, scene: Any, *, image_size: tuple[int, int] | None, time_limit: float | None
) -> TaskSpec:
  """Returns what a task needs of the robot in a scene."""
  if task not in catalogue.ALL_TASKS:
    raise ValueError(errors.unknown_name("task", task, catalogue.ALL_TASKS))
  bundle = open_scene(scene)
  pushes = task == catalogue.BALL_PUSH
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in bundle.extent)
  return TaskSpec(
    goals=find_workspace(bundle).target[None] if pushes else np.asarray(bundle.goals, np.float64),
    goal_lower=lower,
    goal_upper=upper,
    time_limit=catalogue.TIME_LIMITS[task] if time_limit is None else time_limit,
    image_size=image_size,
    head_pan_limit=constants.BALL_PUSHING_HEAD_PAN if pushes else None,
  )


def _open_camera(source: Any, image_size: tuple[int, int]) -> CameraSource:
  if source is None:
    raise ValueError(
      "The robot's camera is missing: give a Connection with camera=..., or image_size=None."
    )
  if hasattr(source, "read"):
    return source
  from nerf2real.real.camera.device import Camera

  camera = Camera.open(source)
  try:
    check_shape(camera.read()[0], image_size)
  except ValueError:
    camera.close()
    raise
  return camera
