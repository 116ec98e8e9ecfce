"""A supervised run: learner, actors and evaluator as processes, with a status on the console."""

import contextlib
import dataclasses
import json
import os
import secrets
import signal
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from nerf2real.agents.link import sessions
from nerf2real.agents.supervision.status_view import StatusView
from nerf2real.agents.supervision.supervisor import (
  Job,
  LocalProcess,
  Process,
  Supervisor,
  has_saved,
)
from nerf2real.core.files import append_line, atomic_path
from nerf2real.core.folder_lock import FolderInUseError, discarded_on, lock_folder

_JOIN_TIMEOUT = 1800.0  # s; a starved machine takes minutes to build the networks, or to be free
_POLL = 0.5  # s between looks at the processes
_LINE_PERIOD = 10.0  # s between lines of status where the output is no terminal
_RESTART_WINDOW = 60.0  # s
_END_TIMEOUT = 60.0  # s for a checkpoint at the end


class RunRefusedError(ValueError):
  """A run cannot start with its settings; the message is one line for the user."""


class _LearnerRefusedError(Exception):
  """The learner's first start was refused; the message is why."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingSettings:
  """What is run, by any placement."""

  env: str | None = None
  """What to learn, such as suite:nerf_nav or dm_control:cartpole:swingup; a resumed run's own if
  not given."""
  actors: int = 2
  """Number of actors."""
  run: Path
  """The run's folder."""
  max_env_steps: int | None = None
  """Environment steps of the run; until it is stopped if not given."""
  preset: str | None = None
  """Settings of the agent to start from: paper, state, ...; "paper" if not given."""
  seed: int | None = None
  """Seed of the run; 0, or a resumed run's own, if not given."""
  resume: bool = False
  """Continue from the newest checkpoint."""
  evaluator: bool = True
  """Whether to start an evaluator."""


@dataclasses.dataclass(frozen=True)
class Scripts:
  """Python scripts of the processes."""

  learner: Path
  """Starts a learner."""
  actor: Path
  """Starts an actor, or with --evaluate the evaluator."""


def check(settings: TrainingSettings) -> None:
  """Raises RunRefusedError for settings that cannot be run; touches nothing."""
  if settings.actors < 1:
    raise RunRefusedError(f"at least one actor is needed, found --actors {settings.actors}")
  saved = has_saved(settings.run / "checkpoints")
  if saved and not settings.resume:
    raise RunRefusedError(
      f"{settings.run} holds a run: add --resume, or name another folder with --run"
    )
  if settings.resume and not saved:
    raise RunRefusedError(
      f"{settings.run} holds no checkpoint to go on from: leave --resume out, or name the folder "
      "of a run with --run"
    )


def make_jobs(
  settings: TrainingSettings,
  scripts: Scripts,
  *,
  learner: Sequence[str],
  actor: Sequence[str],
  forwarded: Sequence[str],
) -> tuple[Job, list[Job]]:
  """Returns the learner's job, and those of actors and evaluator.

  Args:
    settings: the run.
    scripts: of the processes.
    learner: how the learner joins, such as ("--listen", ...).
    actor: how an actor joins, such as ("--connect", ...).
    forwarded: further arguments of the learner, such as ("--set", "batch_size=16").
  """
  own = [*learner, "--run", str(settings.run), *forwarded]
  for name in ("env", "preset", "max_env_steps", "seed"):
    if getattr(settings, name) is not None:
      own += [f"--{name.replace('_', '-')}", str(getattr(settings, name))]
  common = [*actor, "--wait", str(_JOIN_TIMEOUT)]  # the learner says the seed
  roles = {f"actor-{i}": ["--index", str(i)] for i in range(settings.actors)}
  if settings.evaluator:
    roles["evaluator"] = ["--evaluate"]
  return Job(name="learner", script=scripts.learner, arguments=tuple(own)), [
    Job(name=name, script=scripts.actor, arguments=(*common, *role)) for name, role in roles.items()
  ]


def write_private(path: Path, text: str) -> None:
  """Writes a file that only its user may read."""
  with atomic_path(path) as partial:
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w") as stream:
      stream.write(text)


def note_launch(run: Path, command: str) -> None:
  """Appends the command, the time and the hardware to launches.jsonl of the run."""
  info = Path("/proc/cpuinfo")
  lines = info.read_text().splitlines() if info.exists() else []
  row = {
    "time": time.time(),
    "command": command,
    "processor": next((n.partition(":")[2].strip() for n in lines if "model name" in n), ""),
    "cores": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
  }
  append_line(run / "launches.jsonl", json.dumps(row))


def free_port(host: str = "127.0.0.1") -> int:
  """Returns a port of an address that nothing listens on."""
  with socket.socket() as probe:
    probe.bind((host, 0))
    return int(probe.getsockname()[1])


def say(console: Console, text: str) -> None:
  """Prints a line as it is: neither wrapped nor coloured."""
  console.print(text, soft_wrap=True, highlight=False, markup=False)


def supervise(supervisor: Supervisor, view: StatusView, console: Console) -> str:
  """Runs the processes until the learner is over, one cannot be kept alive, or a signal comes.

  Ctrl-C and SIGTERM end the run with a checkpoint.

  Returns:
    Why the run failed, with the last words of what died; empty if it did not.
  """
  stopped: list[int] = []
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda n, _: stopped.append(n))
  reason: str | None = None
  shown = time.monotonic()

  def table() -> Any:
    return view.table(restarts=supervisor.restarts, waiting=supervisor.waiting)

  try:
    supervisor.start()
    with Live(table(), console=console, refresh_per_second=2, transient=False) as live:
      while not stopped and reason is None:
        reason = supervisor.watch()
        view.refresh()
        live.update(table())
        if not console.is_terminal and time.monotonic() - shown > _LINE_PERIOD:
          shown = time.monotonic()
          say(console, view.line(waiting=supervisor.waiting))
        time.sleep(_POLL)
  finally:
    if not console.is_terminal:  # where the table ends without a new line
      console.line()
    if stopped:
      say(console, "Ending: the learner writes a checkpoint.")
    failure = supervisor.end()
  problem = f"\n{view.problem}" if view.problem else ""
  return f"{reason or failure}{problem}" if reason or failure else ""


def train(
  settings: TrainingSettings,
  scripts: Scripts,
  *,
  port: int | None = None,
  forwarded: Sequence[str] = (),
  command: str = "",
) -> str:
  """Trains with all processes on this machine.

  Args:
    settings: the run.
    scripts: of the processes.
    port: the learner's; a free one if None.
    forwarded: further arguments of the learner.
    command: what is noted as the command in launches.jsonl.

  Returns:
    Why the run failed; empty if it did not.

  Raises:
    RunRefusedError: the settings cannot be run, or another process runs in the folder.
  """
  check(settings)
  try:
    with discarded_on(_LearnerRefusedError, settings.run), locked(settings.run):
      return _train(settings, scripts, port=port, forwarded=forwarded, command=command)
  except _LearnerRefusedError as error:
    return str(error)


@contextlib.contextmanager
def locked(run: Path) -> Iterator[None]:
  """Holds the lock of a run's folder, as its one supervisor.

  Raises:
    RunRefusedError: another process holds it.
  """
  try:
    with lock_folder(run):
      yield
  except FolderInUseError as error:
    raise RunRefusedError(str(error)) from error


def _train(
  settings: TrainingSettings,
  scripts: Scripts,
  *,
  port: int | None,
  forwarded: Sequence[str],
  command: str,
) -> str:
  run = settings.run
  (run / "logs").mkdir(parents=True, exist_ok=True)
  # A password of this run's own: others on the machine cannot join.
  users, login = run / "users.txt", run / "login.txt"
  line = f"local:{secrets.token_hex(16)}\n"
  for path in (users, login):
    write_private(path, line)
  note_launch(run, command)
  endpoint = f"tcp/127.0.0.1:{port or free_port()}"
  learner, others = make_jobs(
    settings,
    scripts,
    learner=("--listen", endpoint, "--users", str(users)),
    actor=("--connect", endpoint, "--login", str(login)),
    forwarded=forwarded,
  )

  def start(job: Job) -> Process:
    return LocalProcess(job.script, job.arguments, log=run / "logs" / f"{job.name}.log")

  supervisor = Supervisor(
    start,
    learner,
    others,
    checkpoints=run / "checkpoints",
    resume=settings.resume,
    restart_window=_RESTART_WINDOW,
    end_timeout=_END_TIMEOUT,
  )
  link = sessions.LinkSettings(security=sessions.Security(login=login))
  console = Console()
  view = StatusView(str(run), endpoint, link)
  failure = supervise(supervisor, view, console)
  if supervisor.refused:
    raise _LearnerRefusedError(failure)
  if not failure:
    say_where(console, settings, supervisor)
  return failure


def say_where(console: Console, settings: TrainingSettings, supervisor: Supervisor) -> None:
  """Prints where the run's results are."""
  say(
    console,
    f"The run is in {settings.run}: metrics.jsonl, tensorboard, checkpoints, policy; "
    f"{supervisor.restarts} restarts.",
  )
