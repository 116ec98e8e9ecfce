"""Checks a robot before a policy runs on it: devices, readings, standing, timing."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.real.loading import Connection, load
from nerf2real.real.loop.environment import RobotEnvironment
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.suite.op3 import constants

VIRTUAL = "virtual"
PASSED = "passed"
_IMAGE_SIZE = (60, 80)  # pixels: the larger of the paper's pictures


@contextlib.contextmanager
def connected(robot: str) -> Iterator[str | Connection]:
  """Returns how to reach a robot; `VIRTUAL` is one faster than real time while this is open."""
  if robot != VIRTUAL:
    yield robot
    return
  from nerf2real.real.virtual.robot import VirtualRobot

  with VirtualRobot(stepped=True, seed=0) as virtual:
    yield virtual.connection()


def check(
  robot: str | Connection,
  *,
  camera: str | None = None,
  seconds: float = 5.0,
  offsets: Path | None = None,
  lens: Path | None = None,
  recorder: Any = None,
  dry_run: bool = False,
) -> list[str]:
  """Stands for a while; returns the lines of a report, the last of them `PASSED` if all is well.

  Args:
    robot: Serial port or connection.
    camera: Number of a device, file or address; None checks no pictures.
    seconds: How long the robot stands [s].
    offsets: The robot's offset.yaml.
    lens: The camera's camera_info YAML, for the recording.
    recorder: Records everything.
    dry_run: Reads everything and writes nothing to the servos.
  """
  connection = Connection(port=robot) if isinstance(robot, str) else robot
  with load(
    "nerf_nav",
    robot=dataclasses.replace(connection, camera=camera, offsets=offsets, lens=lens),
    image_size=None if camera is None else _IMAGE_SIZE,
    time_limit=seconds,
    settings=RobotSettings(dry_run=dry_run),
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
  lines.append(PASSED if stop is None else f"STOPPED: {stop.reason} ({stop.detail})")
  return lines
