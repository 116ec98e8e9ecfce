"""Records the motions of a robot: held by its torso in the air, and standing on the floor."""

from pathlib import Path
from typing import Any

import numpy as np

from nerf2real import real
from nerf2real.evaluation.loop.motions import HELD, STANDING, TRAIN, motion
from nerf2real.real.loading import Connection
from nerf2real.real.recorder.recorder import Recorder
from nerf2real.suite.op3 import constants

VIRTUAL = "virtual"
_STEP = constants.CONTROL_TIMESTEP
_LIFTING = 2.0  # s until a robot that was taken by its torso hangs still


def record_motions(out: Path, *, robot: str, seed: int, seconds: float) -> dict[str, np.ndarray]:
  """Records all motions as MCAP; returns actions and joint positions [T, 20] of the standing one.

  Args:
    out: Folder of the logs.
    robot: Serial port, or `VIRTUAL`.
    seed: Of the virtual robot's hidden properties.
    seconds: Length of a motion [s].

  Raises:
    RuntimeError: The recorder or the robot did not keep up.
  """
  if robot != VIRTUAL:
    return _record(Connection(port=robot), out, seconds, None)
  from nerf2real.real.virtual.robot import VirtualRobot

  with VirtualRobot(stepped=True, seed=seed) as virtual:
    return _record(virtual.connection(), out, seconds, virtual)


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


def _record(connection: Connection, out: Path, seconds: float, robot: Any) -> dict[str, np.ndarray]:
  count = round(seconds / _STEP)
  for name in (*TRAIN, *HELD):
    path = out / f"{name}.mcap"
    try:
      with Recorder(path) as recorder:
        _play(connection, motion(name, count), robot, recorder=Gate(recorder), held=True)
    except BaseException:  # a motion that was cut off is nothing to identify from
      path.unlink(missing_ok=True)
      raise
    if recorder.dropped:
      raise RuntimeError(
        f"Found {recorder.dropped} messages missing in {name}.mcap, expected none: the recorder did"
        " not keep up; run again on a machine with less load."
      )
  actions = motion(STANDING, count)
  return {"actions": actions, "positions": _play(connection, actions, robot, held=False)}


def _play(
  connection: Connection,
  actions: np.ndarray,
  robot: Any,
  *,
  held: bool,
  recorder: Gate | None = None,
) -> np.ndarray:
  """Plays actions [T, 20] and returns the joint positions [T, 20] that were observed."""
  rows = []
  lifting = round(_LIFTING / _STEP) if held else 0
  with real.load(
    "nerf_nav",
    robot=connection,
    image_size=None,
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
      timestep = environment.step(action)
      if index >= lifting:
        rows.append(timestep.observation["joint_positions"][-1].copy())
      if timestep.last():
        raise RuntimeError(
          f"Found the episode ended after {len(rows)} steps ({environment.stop}), expected"
          f" {len(actions)}: look at the robot."
        )
    if recorder is not None:
      recorder.open = False
  return np.array(rows)
