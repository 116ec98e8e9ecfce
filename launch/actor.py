"""Starts an actor, or the evaluator.

  python launch/actor.py --connect tcp/host:7447

The environment is in the learner's description. --evaluate makes it the evaluator.
"""

import dataclasses
import logging
import signal
import sys
import uuid
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import tyro

from nerf2real.agents.link import sessions
from nerf2real.agents.supervision.statuses import REFUSED
from nerf2real.launch import command

if TYPE_CHECKING:  # NumPy is loaded after the environment is set
  from nerf2real.agents.link.client import ActorLink

_EVALUATOR_SEED = 1_000_000  # far from the actors' seeds
ENVIRONMENT = {
  **command.NOT_DRAWING,
  **command.ONE_THREAD,
  "JAX_PLATFORMS": "cpu",  # the accelerator is the learner's
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joining:
  """How a process joins a learner."""

  connect: str
  """The learner or router to join, such as tcp/127.0.0.1:7447."""
  index: int = 0
  """Number of this process, for its seed."""
  seed: int = 0
  """The run's seed."""
  evaluate: bool = False
  """Be the evaluator."""
  wait: float = 120.0
  """Time to wait for the learner to appear [s]."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


class Arguments(Joining):
  """Starts an actor, or the evaluator."""


class Process(Protocol):
  """What joins a learner."""

  def run(self) -> None:
    """Works until the run is over or `stop` is called."""

  def stop(self) -> None:
    """Ends `run`; safe in a signal handler."""


def join(
  arguments: Joining,
  *,
  actor: Callable[["ActorLink"], Process],
  evaluator: Callable[["ActorLink"], Process],
) -> None:
  """Joins a learner and works until the run is over or a signal stops the process.

  Args:
    arguments: how to join.
    actor: makes the process without --evaluate.
    evaluator: makes the process with --evaluate.

  Raises:
    CommandError: It cannot join with these arguments (only this ends with `REFUSED`), the learner
      refuses a question, or several episodes in a row failed.
  """
  from nerf2real.agents.link.client import ActorLink
  from nerf2real.agents.link.schema import MessageError
  from nerf2real.agents.processes.joining import EpisodesFailed

  role = "evaluator" if arguments.evaluate else "actor"
  name = f"{role}-{arguments.index}-{uuid.uuid4().hex[:8]}"
  logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {name}: %(message)s", force=True)
  process: Process | None = None

  def stop(*_: object) -> None:
    if process is None:
      sys.exit(0)
    process.stop()

  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, stop)
  try:
    session = sessions.connect(arguments.connect, arguments.link, timeout=arguments.wait)
    link = ActorLink(session, arguments.link, actor=name, role=role)
    process = (evaluator if arguments.evaluate else actor)(link)
  except (sessions.LinkError, MessageError, ValueError) as error:
    raise command.CommandError(error, status=REFUSED) from error
  try:
    process.run()
  except (EpisodesFailed, MessageError) as error:
    raise command.CommandError(error) from error
  finally:
    link.close()


def run(arguments: Arguments) -> None:
  """Acts or evaluates until the run is over or it is stopped.

  Raises:
    CommandError: As `join`.
  """
  from nerf2real.agents.processes.actor import ActorProcess
  from nerf2real.agents.processes.evaluator import EvaluatorProcess

  join(
    arguments,
    actor=lambda link: ActorProcess(link, seed=arguments.seed, index=arguments.index),
    evaluator=lambda link: EvaluatorProcess(link, seed=arguments.seed + _EVALUATOR_SEED),
  )


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
