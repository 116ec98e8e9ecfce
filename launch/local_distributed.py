"""Trains on one machine: `python launch/local_distributed.py --env suite:nerf_nav --run runs/x`.

Starts a learner, actors and an evaluator as processes, replaces those that die, and shows the run's
status. Ctrl-C ends it cleanly, with a checkpoint; --resume goes on. Arguments that this script does
not know go to the learner (see `launch/learner.py --help`), such as --set batch_size=16.
"""

import argparse
import dataclasses
import json
import os
import secrets
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from nerf2real.agents.link import sessions
from nerf2real.agents.link.children import last_lines, start_child
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError

_LAUNCH = Path(__file__).resolve().parent
_MAX_RESTARTS = 5  # of one process within _RESTART_WINDOW
_RESTART_WINDOW = 60.0  # s
_REFUSED = 2  # exit status of a process whose arguments are wrong: another start would not help
_JOIN_TIMEOUT = 1800.0  # s; on a starved machine the learner takes minutes to build its networks
_END_TIMEOUT = 60.0  # s for a checkpoint at the end


@dataclasses.dataclass
class Child:
  """A process that is kept running."""

  name: str
  command: list[str]
  log: Path
  process: subprocess.Popen | None = None
  started: list[float] = dataclasses.field(default_factory=list)

  def start(self) -> None:
    """Starts it; its output is appended to its log."""
    self.started.append(time.monotonic())
    self.process = start_child(self.command, log=self.log)

  @property
  def exit_status(self) -> int | None:
    """The status it ended with; None while it runs."""
    return self.process.poll() if self.process else None

  def signal(self, number: int) -> None:
    """Sends a signal if it runs."""
    if self.process is not None and self.process.poll() is None:
      self.process.send_signal(number)

  @property
  def too_many_restarts(self) -> bool:
    """Whether it died too often lately."""
    now = time.monotonic()
    return sum(now - t < _RESTART_WINDOW for t in self.started) > _MAX_RESTARTS

  def last_words(self) -> str:
    """The end of its log."""
    return last_lines(self.log)


class Supervisor:
  """Keeps a run's processes alive and ends them in order."""

  def __init__(self, arguments: argparse.Namespace, learner_arguments: list[str]):
    run: Path = arguments.run
    (run / "logs").mkdir(parents=True, exist_ok=True)
    self.endpoint = f"tcp/127.0.0.1:{arguments.port or _free_port()}"
    users, login = _credentials(run)
    self.link = sessions.LinkSettings(security=sessions.Security(login=login))
    python = sys.executable
    learner = [
      python,
      str(_LAUNCH / "learner.py"),
      "--run",
      str(run),
      "--listen",
      self.endpoint,
      "--users",
      str(users),
      "--seed",
      str(arguments.seed),
    ]
    learner += learner_arguments
    for name in ("env", "preset", "max_env_steps"):
      if getattr(arguments, name) is not None:
        learner += [f"--{name.replace('_', '-')}", str(getattr(arguments, name))]
    self._learner_command = learner
    first = [*learner, "--resume"] if arguments.resume else learner
    self.learner = Child("learner", first, run / "logs" / "learner.log")
    actor = [
      python,
      str(_LAUNCH / "actor.py"),
      "--connect",
      self.endpoint,
      "--login",
      str(login),
      "--seed",
      str(arguments.seed),
      "--wait",
      str(_JOIN_TIMEOUT),
    ]
    self.others = [
      Child(f"actor-{i}", [*actor, "--index", str(i)], run / "logs" / f"actor-{i}.log")
      for i in range(arguments.actors)
    ]
    if not arguments.no_evaluator:
      self.others.append(Child("evaluator", [*actor, "--evaluate"], run / "logs" / "evaluator.log"))
    self._run = run
    self.restarts = 0

  def start(self) -> None:
    """Starts all processes."""
    for child in (self.learner, *self.others):
      child.start()

  def watch(self) -> str | None:
    """Replaces what died; returns why the run ends ("" for its regular end), or None."""
    status = self.learner.exit_status
    if status == 0:
      return ""
    if status is not None:
      if status == _REFUSED or self.learner.too_many_restarts:
        return f"The learner ended with status {status}:\n{self.learner.last_words()}"
      # Its checkpoint, where there is one, is where it goes on.
      saved = any((self._run / "checkpoints").glob("newest-*"))
      self.learner.command = [*self._learner_command, *(["--resume"] if saved else [])]
      self.restarts += 1
      self.learner.start()
    for child in self.others:
      ended = child.exit_status
      if ended is None or ended == 0:  # 0: the learner has told it to stop
        continue
      if ended == _REFUSED or child.too_many_restarts:
        return f"{child.name} ended with status {ended}:\n{child.last_words()}"
      self.restarts += 1
      child.start()
    return None

  def end(self) -> None:
    """Ends the actors, which deliver what they have, then the learner, which saves."""
    for child in self.others:
      child.signal(signal.SIGTERM)
    self._wait(self.others, timeout=10)
    self.learner.signal(signal.SIGTERM)
    self._wait([self.learner], timeout=_END_TIMEOUT)

  def _wait(self, children: list[Child], *, timeout: float) -> None:
    deadline = time.monotonic() + timeout
    for child in children:
      if child.process is None:
        continue
      try:
        child.process.wait(max(0.1, deadline - time.monotonic()))
      except subprocess.TimeoutExpired:
        child.signal(signal.SIGKILL)
        child.process.wait()


class StatusView:
  """Asks the learner for its status and draws it."""

  def __init__(self, supervisor: Supervisor):
    self._supervisor = supervisor
    self._link: ActorLink | None = None
    self.status: dict[str, Any] = {}
    self.answered = time.monotonic()

  def refresh(self) -> None:
    """Asks once; keeps the last answer while the learner is away."""
    try:
      if self._link is None:
        session = sessions.connect(self._supervisor.endpoint, self._supervisor.link, timeout=0)
        self._link = ActorLink(
          session,
          self._supervisor.link,
          actor=f"viewer-{os.getpid()}",
          role="viewer",
          ask_timeout=1.0,
        )
      answer = self._link.status()
    except (sessions.LinkError, MessageError):
      return
    if answer is not None and answer["status"].get("steps") is not None:
      self.status, self.answered = answer["status"], time.monotonic()

  def table(self) -> Table:
    """The status as a table."""
    s, table = self.status, Table(title=str(self._supervisor.learner.log.parent.parent), box=None)
    table.add_column(justify="right", style="cyan")
    table.add_column()
    if not s:
      table.add_row("", "starting")
      return table
    rows = {
      "steps": f"{s['steps']:,} ({s['steps_per_second']:.0f}/s)",
      "updates": f"{s['updates']:,} ({s['updates_per_second']:.1f}/s)"
      + ("" if s["filled"] else ", filling the replay"),
      "return": f"{_number(s['return'])} acting, {_number(s['evaluation'])} evaluated, "
      f"best {_number(s['best'])}",
      "success": _number(s["success"]),
      "localisation error": _number(s["localisation_error"]) + " m",
      "replay": f"{s['replay_steps']:,} steps",
      "link": f"queue {s['queue']}, dropped {s['dropped']}, refused {s['refused']}, "
      f"sent again {s['duplicates']}",
      "parameters": f"{s['parameters_age']:.1f} s old, version {s['parameters_version']}, "
      f"actors at most {s['parameters_lag']} updates behind",
      "processes": f"{s['actors']} actors alive, {self._supervisor.restarts} restarts",
    }
    if time.monotonic() - self.answered > 5:
      rows["learner"] = f"silent for {time.monotonic() - self.answered:.0f} s"
    if s["problem"]:
      rows["problem"] = s["problem"]
    for name, text in rows.items():
      table.add_row(name, text)
    return table


def _number(value: float | None) -> str:
  return "-" if value is None else f"{value:.3g}"


def _note_launch(run: Path) -> None:
  """Appends the command, the time and the hardware to launches.jsonl of the run."""
  info = Path("/proc/cpuinfo")
  lines = info.read_text().splitlines() if info.exists() else []
  row = {
    "time": time.time(),
    "command": shlex.join(["python", *sys.argv]),
    "processor": next((n.partition(":")[2].strip() for n in lines if "model name" in n), ""),
    "cores": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
  }
  with (run / "launches.jsonl").open("a") as stream:
    stream.write(json.dumps(row) + "\n")


def _free_port() -> int:
  with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    return probe.getsockname()[1]


def _credentials(run: Path) -> tuple[Path, Path]:
  """A password of this run's own, readable by its user alone: others on the machine cannot join."""
  users, login = run / "users.txt", run / "login.txt"
  if not users.exists():
    line = f"local:{secrets.token_hex(16)}\n"
    for path in (users, login):
      descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
      with os.fdopen(descriptor, "w") as stream:
        stream.write(line)
  return users, login


def parse() -> tuple[argparse.Namespace, list[str]]:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--env", help="such as suite:nerf_nav or dm_control:cartpole:swingup")
  parser.add_argument("--actors", type=int, default=2, help="number of actors")
  parser.add_argument("--run", type=Path, required=True, help="the run's folder")
  parser.add_argument("--max-env-steps", type=int, help="environment steps of the run")
  parser.add_argument("--preset", help="paper, state, ...")
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--resume", action="store_true", help="continue from the newest checkpoint")
  parser.add_argument("--no-evaluator", action="store_true", help="do not start an evaluator")
  parser.add_argument("--port", type=int, help="the learner's port; a free one if not given")
  return parser.parse_known_args()


def main() -> int:
  arguments, rest = parse()
  if arguments.actors < 1:
    print(
      f"error: at least one actor is needed, found --actors {arguments.actors}", file=sys.stderr
    )
    return 2
  saved = any((arguments.run / "checkpoints").glob("newest-*"))
  if saved and not arguments.resume:
    print(
      f"error: {arguments.run} holds a run: add --resume, or name another folder with --run",
      file=sys.stderr,
    )
    return 2
  supervisor = Supervisor(arguments, rest)
  _note_launch(arguments.run)
  view = StatusView(supervisor)
  stopped: list[int] = []
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda n, _: stopped.append(n))
  reason: str | None = None
  console = Console()
  supervisor.start()
  try:
    with Live(view.table(), console=console, refresh_per_second=2, transient=False) as live:
      while not stopped and reason is None:
        reason = supervisor.watch()
        view.refresh()
        live.update(view.table())
        time.sleep(0.5)
  finally:
    if stopped:
      console.print("Ending: the learner writes a checkpoint.")
    supervisor.end()
  if reason:
    print(f"error: {reason}", file=sys.stderr)
    return 1
  console.print(f"The run is in {arguments.run}: metrics.jsonl, tensorboard, checkpoints, policy.")
  return 0


if __name__ == "__main__":
  sys.exit(main())
