"""Closes the loop once: excites a robot, records, identifies, simulates with the effects, compares.

  python launch/close_loop.py --robot virtual --seed 1 --out out/loop

The robot is held by its torso in the air and moves all joints: a sweep, a slow motion and steps to
identify from, a motion of other frequencies to judge by. The declared model is the suite's OP3,
held likewise. The table at the end is the gap between robot and suite, joint by joint, on motions
that were not fitted: standing on the floor and in the air, without and with the effects found.
"""

import dataclasses
import sys
from pathlib import Path

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Closes the loop once."""

  robot: str = "virtual"
  """Serial port such as /dev/ttyUSB0, or "virtual"."""
  seed: int = 1
  """Of the virtual robot's hidden properties."""
  seconds: float = 12.0
  """Length of a recorded motion [s]."""
  reuse: bool = False
  """Take the logs that an earlier run left in the folder instead of moving the robot."""
  out: Path = Path("out/loop")
  """Folder for logs, model, report and table."""


def run(arguments: Arguments) -> None:
  """Closes the loop and prints the gap."""
  from nerf2real.evaluation.loop.closing import close_loop

  closed = close_loop(
    arguments.out,
    robot=arguments.robot,
    seed=arguments.seed,
    seconds=arguments.seconds,
    reuse=arguments.reuse,
  )
  print(closed.table)
  print(f"report: {closed.report}")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments, run, environment=command.DRAWING, errors=(ValueError, OSError, RuntimeError)
  )


if __name__ == "__main__":
  sys.exit(main())
