"""Starts a learner: `python launch/learner.py --env suite:nerf_nav --run runs/x`.

Listens on this machine only, unless --listen names another address; then --users is needed. Actors
join with `launch/actor.py --connect`. With --connect it joins a router (`launch/router.py`)
instead, with the login of that router's first user.
"""

import argparse
import json
import logging
import os
import signal
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disabled")  # the environment is only asked for its specs
os.environ.setdefault("OMP_NUM_THREADS", "1")  # NumPy only samples here; XLA has --threads
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.link.arguments import add_link_arguments, link_settings
from nerf2real.agents.link.sessions import LinkError
from nerf2real.agents.processes.checkpoints import CheckpointError, read_info
from nerf2real.agents.processes.learner import Learner, LearnerError, RunSettings
from nerf2real.core.serialization import from_plain

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def parse() -> argparse.Namespace:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--env", help="such as suite:nerf_nav or dm_control:cartpole:swingup")
  parser.add_argument("--run", type=Path, required=True, help="the run's folder")
  where = parser.add_mutually_exclusive_group()
  where.add_argument("--listen", default=DEFAULT_ENDPOINT, help="such as tcp/0.0.0.0:7447")
  where.add_argument("--connect", help="a router to join, such as tcp/head:7447")
  parser.add_argument("--preset", default=None, choices=sorted(configs.PRESETS))
  parser.add_argument(
    "--set",
    action="append",
    default=[],
    metavar="NAME=VALUE",
    help="changes a setting of the agent, such as network.vmax=10",
  )
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--max-env-steps", type=int, help="environment steps of the run")
  parser.add_argument("--minutes", type=float, help="time of the run, over all its parts [min]")
  parser.add_argument("--resume", action="store_true", help="continue from the newest checkpoint")
  parser.add_argument(
    "--init-from",
    type=Path,
    metavar="POLICY",
    help="begin with an exported policy, with fresh optimisers and critic",
  )
  parser.add_argument(
    "--threads",
    type=int,
    default=max(1, _cores() // 2),
    help="processor threads of the updates; half of the cores, the rest is for actors",
  )
  parser.add_argument(
    "--checkpoint-period",
    type=float,
    default=RunSettings.checkpoint_period,
    help="time between checkpoints [s]",
  )
  parser.add_argument(
    "--log-period",
    type=float,
    default=RunSettings.log_period,
    help="time between rows of the log [s]",
  )
  parser.add_argument(
    "--replay-on-disk",
    action="store_true",
    help="keep the replay in files, so that it survives the learner",
  )
  parser.add_argument(
    "--evaluation-period",
    type=int,
    default=RunSettings.evaluation_period,
    help="environment steps between evaluations",
  )
  parser.add_argument(
    "--evaluation-episodes",
    type=int,
    help="episodes of an evaluation; half of the protocol's trials, or 5 without a protocol",
  )
  parser.add_argument(
    "--evaluation-env",
    help="environment of the evaluations; the protocol of the paper's table I for suite:...",
  )
  add_link_arguments(parser, side="learner")
  return parser.parse_args()


def agent_settings(arguments: argparse.Namespace) -> tuple[str, configs.DmpoConfig]:
  """The environment and the agent's settings: those of the checkpoint when a run is resumed."""
  info: dict[str, Any] | None = read_info(arguments.run) if arguments.resume else None
  if info is not None:
    environment, config = info["environment"], from_plain(info["config"], configs.DmpoConfig)
    given = arguments.env or environment
    if given.partition("?")[0] != environment.partition("?")[0]:
      raise ValueError(
        f"{arguments.run} was trained on {environment}, found --env {arguments.env}: only the "
        "options after the question mark may change."
      )
    environment = given
  elif arguments.env is None:
    raise ValueError("Say what to learn, such as --env suite:nerf_nav.")
  else:
    environment, config = arguments.env, configs.preset(arguments.preset or "paper")
  return environment, configs.override(config, dict(map(_assignment, arguments.set)))


def _cores() -> int:
  return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def set_threads(count: int) -> None:
  """Limits XLA's threads on the processor; to be called before the first computation."""
  os.environ.setdefault("NPROC", str(count))  # size of XLA's thread pool
  if count == 1:
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()


def _assignment(text: str) -> tuple[str, Any]:
  name, equals, value = text.partition("=")
  if not equals:
    raise ValueError(f"--set expects NAME=VALUE, found {text!r}.")
  try:
    return name, json.loads(value)
  except json.JSONDecodeError:
    raise ValueError(
      f"--set {name}: expected a number, true, false or a list, found {value!r}."
    ) from None


def main() -> int:
  arguments = parse()
  logging.basicConfig(level=logging.INFO, format="%(asctime)s learner: %(message)s")
  try:
    set_threads(arguments.threads)
    environment, config = agent_settings(arguments)
    settings = RunSettings(
      environment=environment,
      run=arguments.run,
      seed=arguments.seed,
      max_env_steps=arguments.max_env_steps,
      checkpoint_period=arguments.checkpoint_period,
      log_period=arguments.log_period,
      replay_on_disk=arguments.replay_on_disk,
      evaluation_period=arguments.evaluation_period,
      evaluation_episodes=arguments.evaluation_episodes,
      evaluation_environment=arguments.evaluation_env,
      minutes=arguments.minutes,
      init_from=arguments.init_from,
    )
    learner = Learner(
      settings,
      config,
      endpoint=arguments.connect or arguments.listen,
      link=link_settings(arguments),
      resume=arguments.resume,
      join=arguments.connect is not None,
    )
  except (ValueError, OSError, LinkError, CheckpointError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 2
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: learner.stop())
  try:
    learner.run()
  except LearnerError as error:
    print(f"error: {error}", file=sys.stderr)
    return 1
  return 0


if __name__ == "__main__":
  sys.exit(main())
