"""Starts an actor of a run, a collector of a distillation, or the evaluator of either.

  python launch/actor.py --connect tcp/host:7447

What it runs is in the learner's description. --evaluate makes it the evaluator.
"""

import dataclasses
import logging
import signal
import sys
import threading
import uuid
from typing import TYPE_CHECKING

import tyro

from nerf2real.agents.link import sessions
from nerf2real.agents.supervision.statuses import REFUSED
from nerf2real.launch import command

if TYPE_CHECKING:  # NumPy is loaded after the environment is set
  from nerf2real.agents.link.client import ActorLink
  from nerf2real.agents.processes.joining import JoinedProcess

_EVALUATOR_SEED = 1_000_000  # else actor 0's: NumPy's SeedSequence((s,)) is that of (s, 0, 0, 0)
_ENVIRONMENT = {
  **command.NOT_DRAWING,
  **command.ONE_THREAD,
  "JAX_PLATFORMS": "cpu",  # the accelerator is the learner's
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Starts an actor of a run, a collector of a distillation, or the evaluator of either."""

  connect: str
  """The learner or router to join, such as tcp/127.0.0.1:7447."""
  index: int = 0
  """Number of this process, for its seed."""
  seed: int | None = None
  """Seed in place of the run's, which the learner says."""
  evaluate: bool = False
  """Be the evaluator."""
  wait: float = 120.0
  """Time to wait for the learner to appear [s]."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


def run(arguments: Arguments) -> None:
  """Joins a learner and works until the run is over or a signal stops the process.

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
  process: JoinedProcess | None = None
  stopped = threading.Event()  # an exit that is raised during an import may be swallowed

  def stop(*_: object) -> None:
    stopped.set()
    if process is None:
      sys.exit(0)
    process.stop()

  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, stop)
  try:
    session = sessions.connect(arguments.connect, arguments.link, timeout=arguments.wait)
    link = ActorLink(session, arguments.link, actor=name, role=role)
    process = _process(link, arguments, stopped)
    if stopped.is_set():
      process.stop()
  except InterruptedError:
    return
  except (sessions.LinkError, MessageError, ValueError) as error:
    raise command.CommandError(error, status=REFUSED) from error
  try:
    process.run()
  except (EpisodesFailed, MessageError) as error:
    raise command.CommandError(error) from error
  finally:
    link.close()


def _process(link: "ActorLink", arguments: Arguments, stopped: threading.Event) -> "JoinedProcess":
  """Returns what the learner's run needs: its description names the kind of run.

  Raises:
    InterruptedError: `stopped` was set while the learner did not answer.
  """
  from nerf2real.agents.distill.settings import KIND
  from nerf2real.agents.processes.joining import wait_for

  description = wait_for(link.status, stopped)["description"]
  index = arguments.index
  seed = description["seed"] if arguments.seed is None else arguments.seed
  if description.get("kind") == KIND:
    from nerf2real.agents.distill.collecting.collector import Collector
    from nerf2real.agents.distill.collecting.evaluator import Evaluator

    return (
      Evaluator(link, seed=seed) if arguments.evaluate else Collector(link, seed=seed, index=index)
    )
  from nerf2real.agents.processes.actor import ActorProcess
  from nerf2real.agents.processes.evaluator import EvaluatorProcess

  if arguments.evaluate:
    return EvaluatorProcess(link, seed=seed + _EVALUATOR_SEED)
  return ActorProcess(link, seed=seed, index=index)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=_ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
