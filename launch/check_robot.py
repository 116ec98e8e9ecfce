"""Checks a robot before a policy runs on it: devices, readings, standing, timing.

python launch/check_robot.py --robot /dev/ttyUSB0 --dry-run              # reads, moves nothing
python launch/check_robot.py --robot /dev/ttyUSB0 --camera 0 --record out/check.mcap
python launch/check_robot.py --robot virtual                             # a rehearsal

Without --dry-run the robot is held, stands up slowly, is let go, stands, is held again and relaxes.
Any key stops it.
"""

import contextlib
import dataclasses
import logging
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import tyro

from nerf2real import real
from nerf2real.real.loading import Connection
from nerf2real.real.loop.environment import RobotEnvironment
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.safety.monitor import SafetyError
from nerf2real.suite.op3 import constants

VIRTUAL = "virtual"


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Checks a robot before a policy runs on it."""

  robot: str
  """Serial port such as /dev/ttyUSB0; "virtual" for a virtual robot faster than real time."""
  camera: str | None = None
  """Number of a device, a file or the address of a stream; without it no pictures are checked."""
  dry_run: bool = False
  """Reads everything and writes nothing to the servos: nothing moves."""
  seconds: float = 5.0
  """How long the robot stands."""
  offsets: Path | None = None
  """The robot's offset.yaml."""
  lens: Path | None = None
  """The camera's camera_info YAML of launch/calibrate_camera.py, for the recording."""
  record: Path | None = None
  """Where to record everything (.mcap)."""


def check(arguments: Arguments, robot: str | Connection, recorder: Any = None) -> list[str]:
  """Stands for a while; returns the lines of a report."""
  camera: Any = arguments.camera
  if isinstance(camera, str) and camera.isdigit():
    camera = int(camera)
  connection = Connection(port=robot) if isinstance(robot, str) else robot
  with real.load(
    "nerf_nav",
    robot=dataclasses.replace(
      connection, camera=camera, offsets=arguments.offsets, lens=arguments.lens
    ),
    image_size=None if camera is None else (60, 80),
    time_limit=arguments.seconds,
    settings=RobotSettings(dry_run=arguments.dry_run),
    recorder=recorder,
  ) as environment:
    timestep = environment.reset()
    while not timestep.last():
      timestep = environment.step(environment.standing_action)
    return report(environment, timestep.observation)


def report(environment: RobotEnvironment, observation: Any) -> list[str]:
  """Returns what was found, in lines."""
  reading = environment.bus.read_joints() or environment.bus.read_joints()
  board = environment.bus.read_imu() or environment.bus.read_imu()
  lines = ["joint         angle [rad]  of goal  current [A]  temperature [C]"]
  if reading is not None:
    goals = constants.standing_targets()
    rows = zip(
      constants.JOINT_NAMES,
      reading.positions,
      goals,
      reading.currents,
      reading.temperatures,
      strict=True,
    )
    for name, angle, goal, amperes, degrees in rows:
      lines.append(
        f"{name:12s} {angle:+12.3f} {angle - goal:+8.3f} {amperes:+12.2f} {degrees:16.0f}"
      )
  if board is not None:
    lines.append(f"supply {board.voltage:.1f} V")
  tilt = np.rad2deg(np.arccos(np.clip(-observation["gravity"][-1][2], -1, 1)))
  lines.append(f"tilt {tilt:.1f} degrees")
  counts = environment.bus.counts
  joints, imus = counts.joint_losses, counts.imu_losses
  lines.append(
    f"lost readings: joints {joints} of {joints + counts.joint_readings}, "
    f"IMU {imus} of {imus + counts.imu_readings}"
  )
  lines.append(environment.timing.line())
  stop = environment.stop
  lines.append("passed" if stop is None else f"STOPPED: {stop.reason} ({stop.detail})")
  return lines


def run(arguments: Arguments) -> list[str]:
  """Connects and checks."""
  with contextlib.ExitStack() as stack:
    recorder = None
    if arguments.record is not None:
      from nerf2real.real.recorder.recorder import Recorder

      recorder = stack.enter_context(Recorder(arguments.record))
    robot: str | Connection = arguments.robot
    if arguments.robot == VIRTUAL:
      from nerf2real.real.virtual.robot import VirtualRobot

      robot = stack.enter_context(VirtualRobot(stepped=True, seed=0)).connection()
    return check(arguments, robot, recorder)


def main() -> None:
  """Parses the command line and runs."""
  arguments = tyro.cli(Arguments, description=__doc__)
  logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
  try:
    lines = run(arguments)
  except (ValueError, OSError, RuntimeError, SafetyError) as error:
    sys.exit(f"error: {error}")
  print("\n".join(lines))
  if lines[-1] != "passed":
    sys.exit(1)


if __name__ == "__main__":
  main()
