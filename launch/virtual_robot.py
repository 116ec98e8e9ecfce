"""Starts a virtual OP3; prints its serial port and its camera's address, runs until Ctrl-C.

  python launch/virtual_robot.py --world room --seed 1
  python launch/virtual_robot.py --loss 0.05          # a bad cable
  python launch/virtual_robot.py --link /tmp/op3      # the port under a name that stays

Keys, each followed by Enter: h takes hold of the robot, l lets it go, p pushes it, q quits.
"""

import contextlib
import dataclasses
import math
import random
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerf2real.launch import command

if TYPE_CHECKING:
  from nerf2real.real.virtual.robot import VirtualRobot

_BALL_AHEAD = 0.6  # m
_PUSH = 10.0  # N
_PUSH_TIME = 0.2  # s
_REPORT_INTERVAL = 10.0  # s


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Starts a virtual OP3."""

  world: Literal["floor", "room"] = "room"
  """Bare floor, or the built-in room."""
  seed: int | None = None
  """Draws the robot's hidden properties; as in the data sheets if not given."""
  camera: bool = True
  """Whether to stream pictures, which need EGL."""
  ball: bool = False
  """Whether there is a ball, 0.6 m in front of the robot."""
  x: float = 0.0
  """Where the robot is put [m]."""
  y: float = 0.0
  """Where the robot is put [m]."""
  yaw: float = 0.0
  """Its heading [rad]."""
  loss: float = 0.0
  """Share of packets that are lost."""
  link: Path | None = None
  """A symbolic link to the port, for a name that stays the same."""
  seconds: float | None = None
  """Ends after this time; runs until it is stopped if not given."""


def run(arguments: Arguments) -> None:
  """Starts the robot and waits."""
  from nerf2real.real.virtual.camera import VirtualCamera
  from nerf2real.real.virtual.robot import VirtualRobot

  if not 0 <= arguments.loss <= 1:
    raise ValueError(f"--loss {arguments.loss:g}: expected a share, 0 to 1, such as 0.05.")
  camera = VirtualCamera() if arguments.camera else None
  with (
    contextlib.suppress(KeyboardInterrupt),
    VirtualRobot(
      world=arguments.world, seed=arguments.seed, camera=camera, ball=arguments.ball
    ) as robot,
  ):
    robot.faults.loss = arguments.loss
    robot.place(arguments.x, arguments.y, arguments.yaw)
    if arguments.ball:
      robot.place_ball(
        arguments.x + _BALL_AHEAD * math.cos(arguments.yaw),
        arguments.y + _BALL_AHEAD * math.sin(arguments.yaw),
      )
    print(f"port: {robot.port}", flush=True)
    if robot.stream is not None:
      print(f"camera: {robot.stream.url}", flush=True)
    with _linked(arguments.link, robot.port):
      _wait(robot, arguments.seconds)


@contextlib.contextmanager
def _linked(link: Path | None, port: str) -> Iterator[None]:
  if link is None:
    yield
    return
  if link.is_symlink() and not link.exists():  # of a robot that was killed
    link.unlink()
  link.symlink_to(port)
  try:
    yield
  finally:
    link.unlink(missing_ok=True)


def _wait(robot: "VirtualRobot", seconds: float | None) -> None:
  end = float("inf") if seconds is None else time.monotonic() + seconds
  report = time.monotonic() + _REPORT_INTERVAL
  keys = [sys.stdin] if sys.stdin.isatty() else []
  while time.monotonic() < end:
    robot.check()
    ready, _, _ = select.select(keys, (), (), min(0.5, max(0.0, end - time.monotonic())))
    if ready:
      key = sys.stdin.readline().strip()
      if key == "q":
        return
      _do(robot, key)
    if time.monotonic() >= report and sys.stdout.isatty():
      report += _REPORT_INTERVAL
      truth = robot.truth()
      x, y, z = truth.position
      held = ", held" if truth.held else ""
      print(f"torso at {x:+.2f} {y:+.2f} {z:.2f} m, yaw {truth.yaw:+.2f} rad{held}", flush=True)


def _do(robot: "VirtualRobot", key: str) -> None:
  import numpy as np

  if key in ("h", "l"):
    robot.hold(key == "h")
  elif key == "p":
    angle = random.uniform(0, 2 * math.pi)
    robot.push(np.array([_PUSH * math.cos(angle), _PUSH * math.sin(angle), 0.0]))
    time.sleep(_PUSH_TIME)
    robot.push(np.zeros(3))
  else:
    print("h: hold, l: let go, p: push, q: quit", flush=True)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments, run, environment=command.DRAWING, errors=(ValueError, OSError, RuntimeError)
  )


if __name__ == "__main__":
  sys.exit(main())
