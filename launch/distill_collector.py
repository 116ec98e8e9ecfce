"""Starts a collector of a distillation, or its evaluator.

  python launch/distill_collector.py --connect tcp/host:7447

The learner says what to run. --evaluate makes it the evaluator.
"""

import dataclasses
import logging
import signal
import sys
import uuid

import tyro

from nerf2real.agents.link import sessions
from nerf2real.agents.processes.statuses import REFUSED
from nerf2real.launch import command

_ENVIRONMENT = {
  **command.NOT_DRAWING,
  **command.ONE_THREAD,
  "JAX_PLATFORMS": "cpu",  # the accelerator is the learner's
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Starts a collector, or the evaluator."""

  connect: str
  """The learner to join, such as tcp/127.0.0.1:7447."""
  index: int = 0
  """Number of this collector, for its seed."""
  seed: int = 0
  """The run's seed."""
  evaluate: bool = False
  """Evaluate instead of collecting."""
  wait: float = 120.0
  """Time to wait for the learner to appear [s]."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


def run(arguments: Arguments) -> None:
  """Collects or evaluates until the run is over or it is stopped.

  Raises:
    CommandError: It cannot join with these arguments (only this ends with `REFUSED`), the learner
      refuses a question, or several episodes in a row failed.
  """
  from nerf2real.agents.distill.collecting import Collector
  from nerf2real.agents.distill.evaluating import Evaluator
  from nerf2real.agents.link.client import ActorLink
  from nerf2real.agents.link.schema import MessageError

  role = "evaluator" if arguments.evaluate else "actor"
  name = f"{role}-{arguments.index}-{uuid.uuid4().hex[:8]}"
  logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {name}: %(message)s", force=True)
  process: Collector | Evaluator | None = None

  def stop(*_: object) -> None:
    if process is None:
      sys.exit(0)
    process.stop()

  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, stop)
  try:
    session = sessions.connect(arguments.connect, arguments.link, timeout=arguments.wait)
    link = ActorLink(session, arguments.link, actor=name, role=role)
    if arguments.evaluate:
      process = Evaluator(link, seed=arguments.seed)
    else:
      process = Collector(link, seed=arguments.seed, index=arguments.index)
  except (sessions.LinkError, MessageError, ValueError) as error:
    raise command.CommandError(error, status=REFUSED) from error
  try:
    process.run()
  except (RuntimeError, MessageError) as error:
    raise command.CommandError(error) from error
  finally:
    link.close()


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=_ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
