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
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from nerf2real.launch import command

if TYPE_CHECKING:
  from nerf2real.real.recorder.recorder import Recorder


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
  """How long the robot stands [s]."""
  offsets: Path | None = None
  """The robot's offset.yaml."""
  lens: Path | None = None
  """The camera's camera_info YAML of launch/calibrate_camera.py, for the recording."""
  record: Path | None = None
  """Where to record everything (.mcap); a file that is there is kept, and the name refused."""


def run(arguments: Arguments) -> int:
  """Checks and prints the report; returns 0 if the robot passed."""
  from nerf2real.real import check

  logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
  with contextlib.ExitStack() as stack:
    recorder = (
      None if arguments.record is None else stack.enter_context(_recorded(arguments.record))
    )
    lines = check.check(
      stack.enter_context(check.connected(arguments.robot)),
      camera=arguments.camera,
      seconds=arguments.seconds,
      offsets=arguments.offsets,
      lens=arguments.lens,
      recorder=recorder,
      dry_run=arguments.dry_run,
    )
  print("\n".join(lines))
  return 0 if lines[-1] == check.PASSED else command.FAILED


@contextlib.contextmanager
def _recorded(path: Path) -> Iterator["Recorder"]:
  """Gives a recorder; of a robot that is not reached nothing is left.

  Raises:
    RefusedError: The file is there already.
  """
  from nerf2real.real.recorder.recorder import Recorder

  if path.is_file():
    raise command.RefusedError(f"{path} is there already: name another file with --record.")
  with Recorder(path) as recorder:
    try:
      yield recorder
    except BaseException:
      if recorder.empty:
        recorder.abandon()
      raise


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments, run, environment=command.DRAWING, errors=(ValueError, OSError, RuntimeError)
  )


if __name__ == "__main__":
  sys.exit(main())
