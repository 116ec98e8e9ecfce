"""Trains on one machine: learner, actors and evaluator as supervised processes.

  python launch/local_distributed.py --env suite:nerf_nav --actors 2 --run runs/x
  python launch/local_distributed.py --run runs/x --resume

Processes that die are replaced, and the run's status is shown. Ctrl-C ends the run with a
checkpoint; --resume goes on. Arguments that are not listed here go to the learner (see
`launch/learner.py --help`), such as --set batch_size=16.
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerf2real.agents.supervision import training
from nerf2real.launch import command

SCRIPTS = training.Scripts(
  learner=Path(__file__).resolve().parent / "learner.py",
  actor=Path(__file__).resolve().parent / "actor.py",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments(training.TrainingSettings):
  """Trains on one machine."""

  port: int | None = None
  """The learner's port; a free one if not given."""


def run(arguments: Arguments, forwarded: list[str]) -> None:
  """Trains; forwards arguments to the learner.

  Raises:
    CommandError: The run cannot start, or it failed.
  """
  supervised(training.train, arguments, SCRIPTS, forwarded, port=arguments.port)


def supervised(
  train: Callable[..., str],
  arguments: training.TrainingSettings,
  scripts: training.Scripts,
  forwarded: list[str],
  **options: Any,
) -> None:
  """Calls a function that runs a training and returns why it failed, empty if it did not.

  Raises:
    CommandError: The run cannot start, or it failed.
  """
  try:
    failure = train(
      arguments, scripts, forwarded=forwarded, command=command.command_line(), **options
    )
  except training.RunRefusedError as error:
    raise command.CommandError(error, status=command.WRONG_ARGUMENTS) from error
  if failure:
    raise command.CommandError(failure)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, errors=(OSError,), forwards=True)


if __name__ == "__main__":
  sys.exit(main())
