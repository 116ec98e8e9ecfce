"""Builds the robot's environment: the same word as in simulation, another module."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core import errors
from nerf2real.core.camera_info import read_camera_info
from nerf2real.real.camera.pictures import CameraSource
from nerf2real.real.loop.clock import Clock
from nerf2real.real.loop.environment import RobotEnvironment
from nerf2real.real.loop.motion import RobotSettings
from nerf2real.real.safety.operator import Operator, Terminal
from nerf2real.real.wire import op3
from nerf2real.real.wire.bus import Bus
from nerf2real.suite import loading
from nerf2real.suite.op3 import constants
from nerf2real.suite.tasks import ball_push, nerf_nav
from nerf2real.suite.tasks.workspace import find_workspace

_TIME_LIMITS = {nerf_nav.NAME: nerf_nav.TIME_LIMIT, ball_push.NAME: ball_push.TIME_LIMIT}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Connection:
  """Where a robot is reached, if it is more than a serial port."""

  port: str  # path of the serial port
  camera: Any = None  # device number, file, URL, or an object with `read` and `close`
  operator: Operator | None = None  # a person at this terminal if None
  clock: Clock | None = None  # the machine's if None


def load(
  task: str,
  *,
  robot: str | Connection,
  camera: Any = None,
  scene: Any = None,
  image_size: tuple[int, int] | None = (30, 40),
  goal: int | np.ndarray = 0,
  time_limit: float | None = None,
  settings: RobotSettings | None = None,
  offsets: Path | str | None = None,
  lens: Path | str | None = None,
  recorder: Any = None,
  dry_run: bool = False,
) -> RobotEnvironment:
  """Loads a task on a robot. Observations and actions are those of `suite.load`.

  Args:
    task: "nerf_nav" or "ball_push".
    robot: Serial port such as "/dev/ttyUSB0", or a connection.
    camera: Device number, file or URL for `real.camera.device`, or an object with `read` and
      `close`; the connection's if None.
    scene: Folder of a scene bundle, or an opened one, for its goals and extent; None: the built-in
      room.
    image_size: (height, width) of the picture; None for a robot without a camera.
    goal: Index of one of the scene's goals, or a place [2] [m]; `set_goal` changes it.
    time_limit: Length of an episode [s]; the task's own if None.
    settings: Settings of the robot.
    offsets: The robot's `offset.yaml`; none if None.
    lens: The camera's camera_info YAML (`launch/calibrate_camera.py`), for the recording: what the
      camera does can be found in it only with its lens.
    recorder: A `real.recorder.recorder.Recorder`, which the caller closes.
    dry_run: Reads everything and moves nothing.

  Returns:
    The environment. Nothing has moved; `reset` does.

  Raises:
    ValueError: An argument is none of what is expected.
    BusError: A device does not answer or cannot be set up.
    PortError: The serial port cannot be used.
  """
  if task not in _TIME_LIMITS:
    raise ValueError(errors.unknown_name("task", task, tuple(_TIME_LIMITS)))
  connection = Connection(port=robot) if isinstance(robot, str) else robot
  bundle = loading.open_scene(scene)
  if task == ball_push.NAME:
    goals = find_workspace(bundle).target[None]
    head_pan: float | None = constants.BALL_PUSHING_HEAD_PAN
  else:
    goals, head_pan = np.asarray(bundle.goals, np.float64), None
  settings = settings or RobotSettings()
  seen_through = None if lens is None else read_camera_info(Path(lens))
  wiring = op3.Wiring() if offsets is None else op3.read_offsets(offsets)
  bus = Bus(connection.port, settings=settings.bus, wiring=wiring, clock=connection.clock)
  eye: CameraSource | None = None
  operator: Operator | None = None
  try:
    if image_size is not None:
      eye = _open_camera(connection.camera if camera is None else camera, image_size)
    operator = connection.operator or Terminal()
    environment = RobotEnvironment(
      bus,
      camera=eye,
      operator=operator,
      goal_bounds=_floor(bundle.extent),
      goals=goals,
      image_size=image_size,
      head_pan_limit=head_pan,
      settings=settings,
      recorder=recorder,
      time_limit=_TIME_LIMITS[task] if time_limit is None else time_limit,
      dry_run=dry_run,
    )
    environment.set_goal(goal)
    if recorder is not None and seen_through is not None:
      recorder.camera_info(bus.clock.wall(bus.clock.now()), seen_through)
  except BaseException:
    bus.close()
    for opened in (eye, operator):
      if opened is not None:
        opened.close()
    raise
  return environment


def _floor(extent: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
  return lower, upper


def _open_camera(source: Any, image_size: tuple[int, int]) -> CameraSource:
  if source is None:
    raise ValueError("The robot's camera is missing: give camera=..., or image_size=None.")
  if hasattr(source, "read"):
    return source
  from nerf2real.real.camera.device import Camera

  return Camera.open(source, size=image_size)
