"""Trains on several machines: `python launch/cluster.py --env suite:nerf_nav --run runs/x`.

Run it on the head of a Ray cluster (`ray start --head` there, `ray start --address HEAD:6379` on
the others). Ray places the same processes that `launch/local_distributed.py` starts, and places
them again when a machine is lost; data travels over zenoh through a router in this script. Every
machine needs this checkout at the same path and the project installed. The run's folder must be
seen by every machine that may get the learner (a shared disk); --learner-resource pins it to one.
Ctrl-C ends the run with a checkpoint; --resume goes on. Arguments that this script does not know go
to the learner (`launch/learner.py --help`). Needs the extra `cluster`.
"""

import argparse
import dataclasses
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from nerf2real.agents.link import sessions
from nerf2real.agents.link.access import LinkError
from nerf2real.agents.link.children import last_lines, start_child
from nerf2real.agents.link.client import ActorLink
from nerf2real.agents.link.schema import MessageError

_LAUNCH = Path(__file__).resolve().parent
_REFUSED = 2  # exit status of a process whose arguments are wrong: another start would not help
_MAX_RESTARTS = 5  # of one process within _RESTART_WINDOW
_RESTART_WINDOW = 120.0  # s
_POLL = 2.0  # s
_JOIN_TIMEOUT = 1800.0  # s; the learner may wait for a free machine, and builds its networks
_END_TIMEOUT = 90.0  # s for a checkpoint at the end
_LEARNER, _ACTOR = "learner", "actor"  # the users of a run


class Host:
  """Runs one process on the machine where Ray has placed it; becomes a Ray actor."""

  def __init__(self, files: dict[str, str]):
    """Writes small files, such as a login, where only this user reads them."""
    self._folder = Path(tempfile.mkdtemp(prefix="nerf2real-"))
    for name, content in files.items():
      path = self._folder / name
      path.touch(mode=0o600)
      path.write_text(content)
    self._process: subprocess.Popen | None = None

  def start(self, script: str, arguments: list[str]) -> str:
    """Starts launch/<script>; {files} in an argument becomes the folder of the files.

    Returns:
      The machine's name.
    """
    command = [sys.executable, str(_LAUNCH / script)]
    command += [argument.replace("{files}", str(self._folder)) for argument in arguments]
    self._process = start_child(command, log=self._folder / "log")
    return socket.gethostname()

  def exit_status(self) -> int | None:
    """The status that the process ended with; None while it runs."""
    return self._process.poll() if self._process else None

  def last_words(self) -> str:
    """The end of its output."""
    return last_lines(self._folder / "log")

  def end(self, timeout: float) -> int | None:
    """Asks the process to end, waits, and returns its status."""
    if self._process is None:
      return None
    if self._process.poll() is None:
      self._process.terminate()
    try:
      return self._process.wait(timeout)
    except subprocess.TimeoutExpired:
      self._process.kill()
      return self._process.wait()


@dataclasses.dataclass
class Placed:
  """A process of the run, wherever it is now."""

  name: str
  script: str
  arguments: list[str]
  files: dict[str, str]
  needs: dict[str, Any]
  """Options of the Ray actor: num_cpus, num_gpus, resources."""
  host: Any = None
  starting: Any = None
  """The answer to its start, until it is there."""
  machine: str = "no machine yet"
  started: list[float] = dataclasses.field(default_factory=list)
  ended: bool = False

  @property
  def too_many_restarts(self) -> bool:
    """Whether it died too often lately."""
    now = time.monotonic()
    return sum(now - t < _RESTART_WINDOW for t in self.started) > _MAX_RESTARTS


class Cluster:
  """Keeps a run's processes placed and running."""

  def __init__(
    self,
    arguments: argparse.Namespace,
    learner_arguments: list[str],
    endpoint: str,
    passwords: dict[str, str],
  ):
    import ray

    self._ray = ray
    self.restarts = 0
    run = arguments.run.absolute()
    self._run = run
    common = ["--connect", endpoint, "--login", "{files}/login", "--seed", str(arguments.seed)]
    files = {}
    if arguments.tls_certificate:
      common += ["--tls-authority", "{files}/authority"]
      files["authority"] = arguments.tls_authority.read_text()
    learner = [*common, "--run", str(run), *learner_arguments]
    for name in ("env", "preset", "max_env_steps"):
      if getattr(arguments, name) is not None:
        learner += [f"--{name.replace('_', '-')}", str(getattr(arguments, name))]
    resource = {arguments.learner_resource: 1e-3} if arguments.learner_resource else {}
    self._learner_arguments = learner
    self.learner = Placed(
      "learner",
      "learner.py",
      [*learner, *(["--resume"] if arguments.resume else [])],
      files | {"login": f"{_LEARNER}:{passwords[_LEARNER]}\n"},
      {
        "num_cpus": arguments.learner_cpus,
        "num_gpus": arguments.learner_gpus,
        "resources": resource,
      },
    )
    files = files | {"login": f"{_ACTOR}:{passwords[_ACTOR]}\n"}
    wait = ["--wait", str(_JOIN_TIMEOUT)]
    needs = {"num_cpus": arguments.actor_cpus, "scheduling_strategy": "SPREAD"}
    self.others = [
      Placed(f"actor-{i}", "actor.py", [*common, *wait, "--index", str(i)], files, needs)
      for i in range(arguments.actors)
    ]
    self.others.append(
      Placed("evaluator", "actor.py", [*common, *wait, "--evaluate"], files, needs)
    )

  def place(self, placed: Placed) -> None:
    """Asks Ray for a machine and starts the process there, when one is free."""
    placed.started.append(time.monotonic())
    remote = self._ray.remote(Host).options(**placed.needs)
    placed.host = remote.remote(placed.files)
    placed.starting = placed.host.start.remote(placed.script, placed.arguments)

  def _exit_status(self, placed: Placed) -> int | None:
    """The status that a process ended with, -1 if its machine was lost; None while it runs."""
    try:
      if placed.starting is not None:
        if not self._ray.wait([placed.starting], timeout=0)[0]:
          return None
        placed.machine, placed.starting = self._ray.get(placed.starting), None
        print(f"{placed.name} runs on {placed.machine}.", flush=True)
      return self._ray.get(placed.host.exit_status.remote())
    except self._ray.exceptions.RayActorError:
      placed.starting = None
      print(f"{placed.name}: lost, it was on {placed.machine}.", flush=True)
      return -1

  def start(self) -> None:
    """Places all processes, the learner first."""
    for placed in (self.learner, *self.others):
      self.place(placed)

  def watch(self) -> str | None:
    """Replaces what died or lost its machine; returns why the run ends ("": regularly), or None."""
    for placed in (self.learner, *self.others):
      if placed.ended:
        continue
      status = self._exit_status(placed)
      if status is None:
        continue
      if status == 0:
        placed.ended = True
        if placed is self.learner:
          return ""
        continue
      if status == _REFUSED or placed.too_many_restarts:
        return f"{placed.name} ended with status {status}:\n{self._last_words(placed)}"
      self.restarts += 1
      if placed is self.learner:
        saved = any((self._run / "checkpoints").glob("newest-*"))
        placed.arguments = [*self._learner_arguments, *(["--resume"] if saved else [])]
      self._release(placed)
      self.place(placed)
    return None

  def _last_words(self, placed: Placed) -> str:
    try:
      return self._ray.get(placed.host.last_words.remote())
    except self._ray.exceptions.RayActorError:
      return "(its machine was lost)"

  def _release(self, placed: Placed) -> None:
    self._ray.kill(placed.host, no_restart=True)

  def end(self) -> None:
    """Ends the actors, which deliver what they have, then the learner, which saves."""
    for group, timeout in ((self.others, 10.0), ([self.learner], _END_TIMEOUT)):
      asked = [p.host.end.remote(timeout) for p in group if p.host and p.starting is None]
      try:
        self._ray.get(asked, timeout=timeout + 10)
      except (self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError) as error:
        print(f"Not all ended in order: {type(error).__name__}.", flush=True)
    for placed in (self.learner, *self.others):
      if placed.host is not None:
        self._release(placed)


def status_line(link: ActorLink) -> str:
  """The run's figures in one line; empty while the learner does not answer."""
  try:
    answer = link.status()
  except MessageError:
    return ""
  s = answer["status"] if answer else {}
  if s.get("steps") is None:
    return ""
  names = ("return", "evaluation", "success")
  shown = [f"{n} {s[n]:.3g}" for n in names if s.get(n) is not None]
  return (
    f"steps {s['steps']:,} ({s['steps_per_second']:.0f}/s), updates {s['updates']:,} "
    f"({s['updates_per_second']:.1f}/s), {', '.join([*shown, ''])}{s['actors']} actors, "
    f"dropped {s['dropped']}"
  )


def parse() -> tuple[argparse.Namespace, list[str]]:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--env", help="such as suite:nerf_nav")
  parser.add_argument("--run", type=Path, required=True, help="the run's folder")
  parser.add_argument("--actors", type=int, default=8, help="number of actors")
  parser.add_argument("--max-env-steps", type=int, help="environment steps of the run")
  parser.add_argument("--preset", help="paper, state, ...")
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--resume", action="store_true", help="continue from the newest checkpoint")
  parser.add_argument(
    "--address", default="auto", help="Ray's address; local: a cluster of this machine alone"
  )
  parser.add_argument(
    "--listen",
    help="the router's endpoint, such as tls/head:7447;\n"
    "default: a free port of this machine's address in the cluster",
  )
  parser.add_argument("--learner-cpus", type=float, default=2.0)
  parser.add_argument("--learner-gpus", type=float, default=0.0)
  parser.add_argument("--learner-resource", help="Ray resource of the machine for the learner")
  parser.add_argument("--actor-cpus", type=float, default=1.0)
  for name, text in (
    ("certificate", "for a tls/ endpoint [PEM]"),
    ("key", "its private key"),
    ("authority", "who signed it"),
  ):
    parser.add_argument(f"--tls-{name}", type=Path, help=text)
  arguments, rest = parser.parse_known_args()
  tls = [arguments.tls_certificate, arguments.tls_key, arguments.tls_authority]
  if any(tls) and not all(tls):
    parser.error("--tls-certificate, --tls-key and --tls-authority belong together")
  saved = any((arguments.run / "checkpoints").glob("newest-*"))
  if saved and not arguments.resume:
    parser.error(f"{arguments.run} holds a run: add --resume, or name another folder with --run")
  return arguments, rest


def open_router(arguments: argparse.Namespace, host: str) -> tuple[Any, str, dict[str, str]]:
  """Opens the run's router with passwords of its own: session, endpoint, passwords by user."""
  passwords = {user: secrets.token_hex(16) for user in (_LEARNER, _ACTOR)}
  arguments.run.mkdir(parents=True, exist_ok=True)
  users = arguments.run / "users.txt"
  descriptor = os.open(users, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
  with os.fdopen(descriptor, "w") as stream:
    stream.writelines(f"{user}:{password}\n" for user, password in passwords.items())
  endpoint = arguments.listen
  if endpoint is None:
    with socket.socket() as probe:
      probe.bind((host, 0))
      endpoint = f"{'tls' if arguments.tls_certificate else 'tcp'}/{host}:{probe.getsockname()[1]}"
  security = sessions.Security(
    users=users, tls_certificate=arguments.tls_certificate, tls_key=arguments.tls_key
  )
  return sessions.route(endpoint, sessions.LinkSettings(security=security)), endpoint, passwords


def open_view(arguments: argparse.Namespace, endpoint: str) -> ActorLink:
  """Joins the run as an actor's user, to ask for its status."""
  login = arguments.run / "login.txt"
  users = (arguments.run / "users.txt").read_text().splitlines()
  login.touch(mode=0o600)
  login.write_text(users[1] + "\n")
  security = sessions.Security(login=login, tls_authority=arguments.tls_authority)
  settings = sessions.LinkSettings(security=security)
  session = sessions.connect(endpoint, settings, timeout=10)
  return ActorLink(session, settings, actor=f"viewer-{os.getpid()}", role="viewer", ask_timeout=1.0)


def main() -> int:
  arguments, rest = parse()
  try:
    import ray
  except ImportError:
    print("error: Ray is missing: pip install '.[cluster]'", file=sys.stderr)
    return 2
  local = arguments.address == "local"
  try:
    ray.init(
      address=None if local else arguments.address,
      log_to_driver=False,
      include_dashboard=False,
      num_cpus=None,
    )
  except ConnectionError as error:
    print(
      f"error: no Ray cluster at {arguments.address!r} ({error}): start one with "
      "`ray start --head`, or say --address local",
      file=sys.stderr,
    )
    return 2
  stopped: list[int] = []
  for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda n, _: stopped.append(n))
  try:
    host = "127.0.0.1" if local else ray.util.get_node_ip_address()
    router, endpoint, passwords = open_router(arguments, host)
    view = open_view(arguments, endpoint)
  except LinkError as error:
    print(f"error: {error}", file=sys.stderr)
    return 2
  print(f"Routing at {endpoint}.", flush=True)
  cluster = Cluster(arguments, rest, endpoint, passwords)
  reason: str | None = None
  shown = 0.0
  try:
    cluster.start()
    while not stopped and reason is None:
      reason = cluster.watch()
      if time.monotonic() - shown > 10:
        shown = time.monotonic()
        waiting = [p.name for p in (cluster.learner, *cluster.others) if p.starting is not None]
        print(
          status_line(view) + (f" waiting for free CPUs: {waiting}" if waiting else ""), flush=True
        )
      time.sleep(_POLL)
  finally:
    if stopped:
      print("Ending: the learner writes a checkpoint.", flush=True)
    cluster.end()
    view.close()
    sessions.close(router)
    ray.shutdown()
  if reason:
    print(f"error: {reason}", file=sys.stderr)
    return 1
  print(f"The run is in {arguments.run}, {cluster.restarts} restarts.")
  return 0


if __name__ == "__main__":
  sys.exit(main())
