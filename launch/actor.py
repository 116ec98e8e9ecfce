"""Starts an actor, or the evaluator: `python launch/actor.py --connect tcp/host:7447`.

It learns from the learner which environment to run. --evaluate makes it the evaluator.
"""

import argparse
import logging
import os
import signal
import sys
import uuid

# One core an actor: its matrices are small, and threads of BLAS would fight over the machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disabled")  # no environment here draws with GL
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # the accelerator is the learner's

from nerf2real.agents.link import sessions
from nerf2real.agents.link.arguments import add_link_arguments, link_settings
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.processes.actor import ActorProcess, EpisodesFailed, EvaluatorProcess

_EVALUATOR_SEED = 1_000_000  # far from the actors' seeds


def parse() -> argparse.Namespace:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--connect", required=True, help="the learner, such as tcp/127.0.0.1:7447")
  parser.add_argument("--index", type=int, default=0, help="number of this actor, for its seed")
  parser.add_argument("--seed", type=int, default=0, help="the run's seed")
  parser.add_argument("--evaluate", action="store_true", help="evaluate instead of acting")
  parser.add_argument(
    "--wait", type=float, default=120.0, help="time to wait for the learner to appear [s]"
  )
  add_link_arguments(parser, side="actor")
  return parser.parse_args()


def main() -> int:
  arguments = parse()
  role = "evaluator" if arguments.evaluate else "actor"
  name = f"{role}-{arguments.index}-{uuid.uuid4().hex[:8]}"
  logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {name}: %(message)s")
  process: ActorProcess | EvaluatorProcess | None = None

  def stop(*_: object) -> None:
    if process is None:
      sys.exit(0)
    process.stop()

  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, stop)
  settings = link_settings(arguments)
  try:
    session = sessions.connect(arguments.connect, settings, timeout=arguments.wait)
    link = ActorLink(session, settings, actor=name, role=role)
    if arguments.evaluate:
      process = EvaluatorProcess(link, seed=arguments.seed + _EVALUATOR_SEED)
    else:
      process = ActorProcess(link, seed=arguments.seed, index=arguments.index)
  except (sessions.LinkError, MessageError, ValueError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 2  # another start would not help: only joining ends so
  try:
    process.run()
  except (EpisodesFailed, MessageError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 1
  finally:
    link.close()
  return 0


if __name__ == "__main__":
  sys.exit(main())
