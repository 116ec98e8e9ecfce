"""Distils a scripted or privileged teacher into a vision policy, by DAgger.

Starts the learner, collectors that label what teacher and student visit, and an evaluator; ends
after --minutes of training, or with Ctrl-C, and goes on with --resume. The student in
RUN/policy/newest is an exported policy like any other.

python launch/distill.py --run runs/walk --preset nerf_nav --minutes 120 --collectors 2
python launch/evaluate.py --policy runs/walk/policy/newest --plant sim --protocol navigation
"""

# ruff: noqa: E402  (threads are chosen before numpy, jax and mujoco are imported)

import dataclasses
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import uuid
from pathlib import Path
from typing import Any, Literal

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
  os.environ.setdefault(_name, "1")
os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing here draws with GL

import tyro

from nerf2real.agents.distill.settings import PRESETS, SETTINGS, DistillSettings, preset
from nerf2real.agents.link import sessions
from nerf2real.agents.link.children import start_child
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError
from nerf2real.core.serialization import read_json

_WAIT = 120.0  # s for the learner to appear
_RESTART_PERIOD = 5.0  # s between looks for children that ended
_MAX_RESTARTS = 5  # of a child
_END_TIMEOUT = 30.0  # s for children to deliver what they have, at the end


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Distils a teacher into a vision policy."""

  run: Path | None = None
  """Folder of the run."""
  preset: str = "nerf_nav"
  """Settings to begin with: nerf_nav, or tiny to try the machinery."""
  env: str | None = None
  """Another environment than the preset's, such as "suite:nerf_nav?scene=out/room"."""
  teacher: str | None = None
  """Another teacher than the preset's: quick, steady, or the folder of an exported policy."""
  minutes: float = 60.0
  """Training time over all parts of the run [min]."""
  collectors: int = 1
  """Processes that collect."""
  no_evaluator: bool = False
  """Does not evaluate during the run."""
  seed: int = 0
  """Seed of the run."""
  resume: bool = False
  """Continues the run in the folder, with the settings it began with."""
  threads: int = 1
  """Processor threads of the updates."""
  listen: str | None = None
  """Address for collectors of other machines, such as tcp/0.0.0.0:7447; needs --users."""
  users: Path | None = None
  """File of lines user:password; only these join."""
  role: Literal["learner", "collector", "evaluator"] = "learner"
  """What this process is; collectors on other machines are started with --role collector."""
  connect: str | None = None
  """Collectors and evaluator: the learner's address."""
  login: Path | None = None
  """Collectors and evaluator: file with one line user:password."""
  index: int = 0
  """Number of a collector, for its seed."""


def settings_of(arguments: Arguments) -> DistillSettings:
  """Returns the settings of a run: the preset's with changes, or those it began with."""
  if arguments.resume:
    assert arguments.run is not None
    return read_json(arguments.run / SETTINGS, DistillSettings)
  if arguments.preset not in PRESETS:
    raise ValueError(f"Unknown preset {arguments.preset!r}: expected one of {', '.join(PRESETS)}.")
  changes: dict[str, Any] = {}
  if arguments.env is not None:
    changes["environment"] = arguments.env
  if arguments.teacher is not None:
    changes["teacher"] = arguments.teacher
  return dataclasses.replace(preset(arguments.preset), **changes)


def _set_threads(count: int) -> None:
  os.environ.setdefault("NPROC", str(count))  # size of XLA's thread pool
  if count == 1:
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()


def _free_endpoint() -> str:
  with socket.socket() as found:
    found.bind(("127.0.0.1", 0))
    return f"tcp/127.0.0.1:{found.getsockname()[1]}"


class Children:
  """Collectors and evaluator of this machine; one that dies is started again."""

  def __init__(self, arguments: Arguments, endpoint: str, logs: Path):
    """Notes what to start.

    Args:
      arguments: of the learner.
      endpoint: where it listens.
      logs: folder of the children's output.
    """
    logs.mkdir(parents=True, exist_ok=True)
    common = [sys.executable, str(Path(__file__).resolve()), "--connect", endpoint]
    common += ["--seed", str(arguments.seed)]
    if arguments.users is not None:
      common += ["--login", str(arguments.users)]
    self._commands = {
      f"collector-{index}": [*common, "--role", "collector", "--index", str(index)]
      for index in range(arguments.collectors)
    }
    if not arguments.no_evaluator:
      self._commands["evaluator"] = [*common, "--role", "evaluator"]
    self._logs = logs
    self._starts = dict.fromkeys(self._commands, 0)
    self._running: dict[str, Any] = {}
    self._ended = threading.Event()
    self._thread = threading.Thread(target=self._watch, daemon=True)

  def start(self) -> None:
    """Starts all."""
    for name in self._commands:
      self._start(name)
    self._thread.start()

  def end(self, *, patience: float) -> None:
    """Waits up to `patience` seconds for them to end by themselves, then ends them."""
    self._ended.set()
    self._thread.join()
    for process in self._running.values():
      try:
        process.wait(timeout=patience)
      except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)

  def _start(self, name: str) -> None:
    self._starts[name] += 1
    self._running[name] = start_child(self._commands[name], log=self._logs / f"{name}.log")

  def _watch(self) -> None:
    while not self._ended.wait(_RESTART_PERIOD):
      for name, process in list(self._running.items()):
        if process.poll() in (None, 0) or self._starts[name] > _MAX_RESTARTS:
          continue
        logging.warning("%s ended with status %s; see its log.", name, process.poll())
        self._start(name)


def run_learner(arguments: Arguments) -> int:
  """Runs learner and children until the run is over."""
  _set_threads(arguments.threads)
  if arguments.run is None:
    raise ValueError("Say where the run shall be kept, such as --run runs/walk.")
  arguments.run.mkdir(parents=True, exist_ok=True)
  settings = settings_of(arguments)
  endpoint = arguments.listen or _free_endpoint()
  link = sessions.LinkSettings(security=sessions.Security(users=arguments.users))
  # Before JAX: a process with its threads should not fork. They wait for the learner.
  children = Children(arguments, endpoint, arguments.run / "logs")
  children.start()
  session = sessions.listen(endpoint, link)
  try:
    from nerf2real.agents.distill.learner import Learner

    learner = Learner(
      settings,
      arguments.run,
      session=session,
      link=link,
      seed=arguments.seed,
      minutes=arguments.minutes,
      resume=arguments.resume,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
      signal.signal(number, lambda *_: learner.stop())
    learner.run()
    children.end(patience=_END_TIMEOUT)
    learner.close()
  finally:
    children.end(patience=0.0)
    sessions.close(session)
  print(f"wrote {arguments.run / 'policy' / 'newest'}")
  return 0


def run_child(arguments: Arguments) -> int:
  """Runs a collector or the evaluator."""
  from nerf2real.agents.distill.collecting import Collector
  from nerf2real.agents.distill.evaluating import Evaluator

  if arguments.connect is None:
    raise ValueError(f"--role {arguments.role} needs --connect, the learner's address.")
  role = "evaluator" if arguments.role == "evaluator" else "actor"
  name = f"{role}-{arguments.index}-{uuid.uuid4().hex[:8]}"
  link_settings = sessions.LinkSettings(security=sessions.Security(login=arguments.login))
  session = sessions.connect(arguments.connect, link_settings, timeout=_WAIT)
  link = ActorLink(session, link_settings, actor=name, role=role)
  process: Collector | Evaluator
  if role == "evaluator":
    process = Evaluator(link, seed=arguments.seed)
  else:
    process = Collector(link, seed=arguments.seed, index=arguments.index)
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: process.stop())
  try:
    process.run()
  finally:
    link.close()
  return 0


def main() -> int:
  """Parses the command line and runs."""
  arguments = tyro.cli(Arguments, description=__doc__)
  logging.basicConfig(
    level=logging.INFO, format=f"%(asctime)s {arguments.role}: %(message)s", force=True
  )
  try:
    return run_learner(arguments) if arguments.role == "learner" else run_child(arguments)
  except (ValueError, OSError, RuntimeError, sessions.LinkError, MessageError) as error:
    print(f"error: {error}", file=sys.stderr)
    return 1


if __name__ == "__main__":
  sys.exit(main())
