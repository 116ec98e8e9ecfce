"""Starts a learner, which owns a run's replay and parameters.

  python launch/learner.py --env suite:nerf_nav --run runs/x

Listens on this machine only, unless --listen names another address; then --users is needed. Actors
join with `launch/actor.py --connect`. With --connect it joins a router (`launch/router.py`)
instead, with the login of that router's first user.
"""

import dataclasses
import json
import logging
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from nerf2real.agents.dmpo import config as configs
from nerf2real.agents.dmpo import presets
from nerf2real.agents.link import sessions
from nerf2real.agents.supervision.statuses import NOT_SAVED
from nerf2real.core.serialization import from_plain
from nerf2real.launch import command

# NumPy only samples here; XLA has --threads.
_ENVIRONMENT = {**command.NOT_DRAWING, **command.ONE_THREAD}
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_CORES = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
_ASSIGNMENT = tyro.conf.arg(metavar="NAME=VALUE")
_WHERE = tyro.conf.create_mutex_group(required=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Starts a learner."""

  env: str | None = None
  """What to learn, such as suite:nerf_nav or dm_control:cartpole:swingup; a resumed run's own if
  not given."""
  run: Path
  """The run's folder."""
  listen: Annotated[str, _WHERE] = DEFAULT_ENDPOINT
  """Where to listen, such as tcp/0.0.0.0:7447."""
  connect: Annotated[str | None, _WHERE] = None
  """A router to join instead, such as tcp/head:7447."""
  preset: str | None = None
  """Settings of the agent to start from: paper, state, ... (a wrong name lists all); "paper" if not
  given."""
  set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], _ASSIGNMENT] = ()
  """Changes a setting of the agent, such as network.vmax=10; may be repeated."""
  seed: int | None = None
  """Seed of parameters, sampling and, with an actor's number, of its episodes; 0, or a resumed
  run's own, if not given."""
  max_env_steps: int | None = None
  """Environment steps of the run; until it is stopped if not given."""
  minutes: float | None = None
  """Time of the run, over all its parts [min]; until it is stopped if not given."""
  init_from: Path | None = None
  """Folder of an exported policy to begin with, with fresh optimisers and critic; random weights if
  not given."""
  prior_data: Path | None = None
  """Folder of an earlier run whose replay, or a distillation whose episodes, are mixed into the
  batches; none if not given."""
  prior_share: float = 0.5
  """Share of the prior data in every batch."""
  prior_steps: int = 200_000
  """Environment steps of the prior data to read: the last ones [steps]."""
  threads: int = max(1, _CORES // 2)
  """Processor threads of the updates: half of the cores, the rest is for actors."""
  resume: bool = False
  """Continue from the newest checkpoint."""
  checkpoint_period: float = 300.0
  """Time between checkpoints [s]."""
  log_period: float = 10.0
  """Time between the learner's rows in the log [s]."""
  replay_on_disk: bool = False
  """Keep the replay in files, so that it survives the learner."""
  evaluation_period: int = 10_000
  """Environment steps between evaluations [steps]."""
  evaluation_episodes: int | None = None
  """Episodes of an evaluation; half of the protocol's trials, or 5 without a protocol, if not
  given."""
  evaluation_env: str | None = None
  """Environment of the evaluations; for suite:... the protocol of the paper's table I if not
  given."""
  link: tyro.conf.OmitArgPrefixes[sessions.LinkSettings] = sessions.LinkSettings()
  """The link's settings."""


def agent_settings(arguments: Arguments) -> tuple[str, configs.DmpoConfig]:
  """Returns the environment and the agent's settings; a resumed run's are in its checkpoint.

  Raises:
    ValueError: A setting is unknown, or the run is one of another environment.
  """
  from nerf2real.agents.processes.checkpoints import read_info

  info: dict[str, Any] | None = read_info(arguments.run) if arguments.resume else None
  if arguments.resume and info is None:
    raise ValueError(f"{arguments.run} holds no checkpoint to go on from: leave --resume out.")
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
    environment, config = arguments.env, presets.preset(arguments.preset or "paper")
  return environment, configs.override(config, dict(map(_assignment, arguments.set)))


def seed_of(arguments: Arguments) -> int:
  """Returns the run's seed: the one given, or else a resumed run's own, or 0."""
  from nerf2real.agents.processes.checkpoints import read_info

  if arguments.seed is not None:
    return arguments.seed
  info = read_info(arguments.run) if arguments.resume else None
  return 0 if info is None else int(info.get("seed", 0))


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


def run(arguments: Arguments) -> None:
  """Learns until the run is over or it is stopped.

  Raises:
    CommandError: It cannot start with these arguments, trajectories can no longer be taken in, or
      what was learned was not saved.
  """
  logging.basicConfig(level=logging.INFO, format="%(asctime)s learner: %(message)s")
  set_threads(arguments.threads)
  with command.learner_folder(arguments.run):
    _learn(arguments)


def _learn(arguments: Arguments) -> None:
  from nerf2real.agents.processes.checkpoints import CheckpointError
  from nerf2real.agents.processes.learner import Learner, LearnerError
  from nerf2real.agents.processes.settings import RunSettings

  try:
    environment, config = agent_settings(arguments)
    if arguments.connect is None:
      sessions.check_listening(arguments.listen, arguments.link)
    names = {field.name for field in dataclasses.fields(RunSettings)} - {"environment", "seed"}
    settings = RunSettings(
      environment=environment,
      seed=seed_of(arguments),
      **{name: getattr(arguments, name) for name in names},
    )
    learner = Learner(
      settings,
      config,
      endpoint=arguments.connect or arguments.listen,
      link=arguments.link,
      resume=arguments.resume,
      join=arguments.connect is not None,
    )
  except (ValueError, OSError, sessions.LinkError, CheckpointError) as error:
    raise command.RefusedError(error) from error
  _say_hello(arguments, learner)
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: learner.stop())
  try:
    learner.run()
  except LearnerError as error:
    raise command.CommandError(error) from error
  if learner.problem:
    raise command.CommandError(
      f"The run ended and was not saved: {learner.problem}", status=NOT_SAVED
    )


def _say_hello(arguments: Arguments, learner: Any) -> None:
  """Logs where the learner listens, what it goes on from and what it computes on."""
  import jax

  device = jax.devices()[0]
  counts = f"{learner.limiter.steps:,} steps and {learner.limiter.updates:,} updates"
  logging.info(
    "Listening at %s." if not arguments.connect else "Joined %s.",
    arguments.connect or arguments.listen,
  )
  logging.info("Resumed with %s." if arguments.resume else "A new run: %s.", counts)
  logging.info("Updates on %s (%s).", device.device_kind, device.platform)


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=_ENVIRONMENT, errors=())


if __name__ == "__main__":
  sys.exit(main())
