"""Starts a collector of a distillation, or its evaluator.

  python launch/distill_collector.py --connect tcp/host:7447

What it runs is in the learner's description. --evaluate makes it the evaluator.
"""

import sys

from nerf2real.launch import command
from nerf2real.launch.actor import ENVIRONMENT, Joining, join


class Arguments(Joining):
  """Starts a collector, or the evaluator."""


def run(arguments: Arguments) -> None:
  """Collects or evaluates until the run is over or it is stopped.

  Raises:
    CommandError: As `actor.join`.
  """
  from nerf2real.agents.distill.collecting.collector import Collector
  from nerf2real.agents.distill.collecting.evaluator import Evaluator

  join(
    arguments,
    actor=lambda link: Collector(link, seed=arguments.seed, index=arguments.index),
    evaluator=lambda link: Evaluator(link, seed=arguments.seed),
  )


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
