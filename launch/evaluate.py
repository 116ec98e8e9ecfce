"""Evaluates a policy as the paper does, in simulation, on a virtual robot or on a robot.

Every run adds its episodes to a folder, from which one report is made: run it with `--plant sim`
and `--plant virtual` into the same folder for tables with both side by side. A run that was cut
short goes on where it stopped.

  python launch/evaluate.py --policy walker --plant sim --protocol navigation --out out/evaluation
  python launch/evaluate.py --policy runs/nav/policy/best --plant both --robot-seed 1 2 3
  python launch/evaluate.py --policy runs/nav/policy/best --plant sim --control black
  python launch/evaluate.py --policy walker --plant robot --robot /dev/ttyUSB0 --camera 0 --dry-run
"""

import dataclasses
import functools
import sys

from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments(EvaluationSettings):
  """Evaluates a policy as the paper does."""


def run(arguments: Arguments) -> None:
  """Evaluates and prints the tables."""
  from nerf2real.evaluation import session

  path = session.evaluate(arguments, functools.partial(print, flush=True))
  print("dry run: nothing moved, nothing kept" if path is None else f"wrote {path}")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments,
    run,
    environment=command.DRAWING | command.ONE_THREAD,
    errors=(ValueError, OSError, RuntimeError, EOFError),
    interrupted="stopped: the same command goes on from here",
  )


if __name__ == "__main__":
  sys.exit(main())
