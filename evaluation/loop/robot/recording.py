"""Records the motions that identification needs: held in the air, standing, turned on the floor."""

from pathlib import Path
from typing import Any

import numpy as np

from nerf2real import real
from nerf2real.evaluation.loop.robot.motions import HELD, STANDING, TRAIN, motion
from nerf2real.real.loading import Connection
from nerf2real.real.recorder.recorder import Recorder
from nerf2real.suite.op3 import constants

VIRTUAL = "virtual"
FLOOR = "floor"
FILMED = "slow"  # the motion whose pictures are kept: features are followed best
_STEP = constants.CONTROL_TIMESTEP
_LIFTING = 2.0  # s until a robot that was taken by its torso hangs still
_PICTURE = (30, 40)  # height and width of the environment's; the log holds the camera's own
_HEADINGS = (0.0, 1.2, 2.4, 3.6)  # rad: the floor's slope takes three at least
_TURNING = 1.0  # rad/s at which a person turns the robot
_STANDING = 2.0  # s at each heading


class Gate:
  """A recorder that notes nothing until it is opened: what happens before is no part of a log."""

  def __init__(self, recorder: Recorder):
    """Takes the recorder, closed."""
    self._recorder = recorder
    self.open = False

  def __getattr__(self, name: str) -> Any:
    """Returns the recorder's method, or one that does nothing."""
    return getattr(self._recorder, name) if self.open else _ignore


def _ignore(*_: Any, **__: Any) -> None:
  """Notes nothing."""


def record_stand(
  out: Path, connection: Connection, robot: Any, *, seconds: float, lens: Any = None
) -> None:
  """Records the motions of a robot that is held by its torso in the air, as MCAP.

  Args:
    out: Folder of the logs; those that it holds are kept.
    connection: Of the robot.
    robot: The virtual one; None: a person at the terminal is asked to hold the robot.
    seconds: Length of a motion [s].
    lens: The camera's declared lens; `FILMED` is then filmed.

  Raises:
    RuntimeError: The recorder or the robot did not keep up.
  """
  for name in (*TRAIN, *HELD):
    path = out / f"{name}.mcap"
    filmed = lens if name == FILMED else None

    def play(gate: Gate, name: str = name, filmed: Any = filmed) -> None:
      actions = motion(name, round(seconds / _STEP))
      play_actions(connection, actions, robot, recorder=gate, held=True, lens=filmed)

    record(path, play)


def record(path: Path, play: Any) -> None:
  """Writes one log whole; `play` is called with a `Gate` before the recorder. What exists is kept.

  Raises:
    RuntimeError: The recorder did not keep up.
  """
  if path.exists():
    return
  partial = path.with_suffix(".partial.mcap")
  with Recorder(partial) as recorder:
    play(Gate(recorder))
  if recorder.dropped:
    raise RuntimeError(
      f"Found {recorder.dropped} messages missing in {path.name}, expected none: the recorder did"
      " not keep up; run again on a machine with less load."
    )
  partial.replace(path)


def record_standing(connection: Connection, robot: Any, *, seconds: float) -> dict[str, np.ndarray]:
  """Plays the motion on the floor; returns its actions and joint positions [T, 20] [rad]."""
  actions = motion(STANDING, round(seconds / _STEP))
  return {"actions": actions, "positions": play_actions(connection, actions, robot, held=False)}


def record_floor(out: Path, connection: Connection, robot: Any) -> None:
  """Records a robot that stands, is lifted, turned and put down, as MCAP; see `record_stand`."""

  def play(gate: Gate) -> None:
    still = motion(STANDING, 1)[0]
    with real.load(
      "nerf_nav", robot=connection, image_size=None, recorder=gate, time_limit=120.0
    ) as environment:
      environment.reset()
      gate.open = True
      for turn in (*np.diff(_HEADINGS), None):
        _hold_pose(environment, still, _STANDING)
        if turn is None:
          break
        _turn(environment, still, robot, float(turn))
      gate.open = False

  record(out / f"{FLOOR}.mcap", play)


def _turn(environment: Any, still: np.ndarray, robot: Any, angle: float) -> None:
  """Has the robot lifted, turned by an angle [rad] and put down."""
  if robot is None:
    print(f"Lift the robot, turn it by {np.rad2deg(angle):.0f} degrees to the left, put it down.")
    _hold_pose(environment, still, 3 * angle / _TURNING)
    return
  robot.hold(True)
  yaw, steps = robot.truth().yaw, round(angle / _TURNING / _STEP)
  for step in range(1, steps + 1):
    robot.turn(yaw + angle * step / steps)
    _step(environment, still)
  robot.hold(False)
  _hold_pose(environment, still, 1.0)


def _hold_pose(environment: Any, still: np.ndarray, seconds: float) -> None:
  for _ in range(round(seconds / _STEP)):
    _step(environment, still)


def _step(environment: Any, action: np.ndarray) -> Any:
  """Takes a control step; raises RuntimeError where the robot stopped."""
  timestep = environment.step(action)
  if timestep.last():
    raise RuntimeError(
      f"Found the episode ended before its motion ({environment.stop}): look at the robot."
    )
  return timestep


def play_actions(
  connection: Connection,
  actions: np.ndarray,
  robot: Any,
  *,
  held: bool,
  recorder: Gate | None = None,
  lens: Any = None,
) -> np.ndarray:
  """Plays actions [T, 20] and returns the joint positions [T, 20] that were observed."""
  rows = []
  lifting = round(_LIFTING / _STEP) if held else 0
  with real.load(
    "nerf_nav",
    robot=connection,
    image_size=None if lens is None else _PICTURE,
    time_limit=(lifting + len(actions)) * _STEP + 1.0,
    recorder=recorder,
  ) as environment:
    environment.reset()
    if held:
      if robot is not None:
        robot.hold(True)
      else:
        print(f"Lift the robot by its torso, feet off the ground, within {_LIFTING:g} s.")
    for index, action in enumerate([*np.repeat(actions[:1], lifting, axis=0), *actions]):
      if index == lifting and recorder is not None:
        recorder.open = True
        if lens is not None:
          clock = environment.bus.clock
          recorder.camera_info(clock.wall(clock.now()), lens)
      timestep = _step(environment, action)
      if index >= lifting:
        rows.append(timestep.observation["joint_positions"][-1].copy())
    if recorder is not None:
      recorder.open = False
  return np.array(rows)
