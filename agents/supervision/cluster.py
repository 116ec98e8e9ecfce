"""A supervised run on several machines: Ray places the processes, zenoh carries the data.

The processes are those of `training.py`; a router in this process joins them, so that their common
address stays the same where the learner is placed again.
"""

import dataclasses
import secrets
import socket
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from nerf2real.agents.link import sessions
from nerf2real.agents.supervision import training
from nerf2real.agents.supervision.status_view import StatusView
from nerf2real.agents.supervision.supervisor import Job, LocalProcess, Process, Supervisor
from nerf2real.agents.supervision.training import RunRefusedError, Scripts, TrainingSettings

_RESTART_WINDOW = 120.0  # s
_END_TIMEOUT = 90.0  # s for a checkpoint at the end
_GRACE = 10.0  # s that an answer of a host may take longer than what it waits for
_LEARNER, _ACTOR = "learner", "actor"  # the users of a run


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClusterSettings(TrainingSettings):
  """A run and its machines."""

  actors: int = 8
  """Number of actors."""
  address: str = "auto"
  """Ray's address; "local": a cluster of this machine alone."""
  listen: str | None = None
  """The router's endpoint, such as tls/head:7447; a free port of this machine's address in the
  cluster if not given."""
  learner_cpus: float = 2.0
  """CPUs that the learner needs."""
  learner_gpus: float = 0.0
  """GPUs that the learner needs."""
  learner_resource: str | None = None
  """Ray resource of the machine for the learner."""
  actor_cpus: float = 1.0
  """CPUs that an actor needs."""
  tls_certificate: Path | None = None
  """Certificate for a tls/ endpoint [PEM]."""
  tls_key: Path | None = None
  """The certificate's private key [PEM]."""
  tls_authority: Path | None = None
  """Certificate of the authority that signed it [PEM]."""


class Host:
  """Runs one process on the machine where Ray has placed it; becomes a Ray actor."""

  def __init__(self, files: dict[str, str]):
    """Writes small files, such as a login, where only this user reads them."""
    self._folder = Path(tempfile.mkdtemp(prefix="nerf2real-"))
    for name, content in files.items():
      training.write_private(self._folder / name, content)
    self._process: LocalProcess | None = None

  def start(self, script: Path, arguments: Sequence[str]) -> str:
    """Starts the script and returns the machine's name."""
    own = [argument.replace("{files}", str(self._folder)) for argument in arguments]
    self._process = LocalProcess(script, own, log=self._folder / "log")
    return socket.gethostname()

  def exit_status(self) -> int | None:
    """Returns the status that the process ended with; None while it runs."""
    return self._process.exit_status() if self._process else None

  def last_words(self) -> str:
    """Returns the end of its output."""
    return self._process.last_words() if self._process else ""

  def end(self, timeout: float) -> int | None:
    """Ends the process, waits, and returns its status."""
    if self._process is None:
      return None
    self._process.terminate(timeout)
    return self._process.wait()


class PlacedProcess:
  """A process on a machine that Ray chose."""

  def __init__(self, ray: Any, job: Job, report: Callable[[str], None]):
    """Has Ray place the process; it starts when a machine is free.

    Args:
      ray: the module.
      job: what is started.
      report: called with lines about where the process is.
    """
    self._ray, self._name, self._report = ray, job.name, report
    self._host = ray.remote(Host).options(**job.needs).remote(dict(job.files))
    self._starting = self._host.start.remote(job.script, job.arguments)
    self._machine = "no machine yet"
    self._ending: Any = None
    self._timeout = 0.0
    self.waiting = True

  def exit_status(self) -> int | None:
    try:
      if self.waiting:
        if not self._ray.wait([self._starting], timeout=0)[0]:
          return None
        self._machine, self.waiting = self._ray.get(self._starting), False
        self._report(f"{self._name} runs on {self._machine}.")
      return self._ray.get(self._host.exit_status.remote())
    except self._ray.exceptions.RayActorError:
      self.waiting = False
      self._report(f"{self._name}: lost, it was on {self._machine}.")
      return -1

  def last_words(self) -> str:
    try:
      return self._ray.get(self._host.last_words.remote())
    except self._ray.exceptions.RayActorError:
      return "(its machine was lost)"

  def terminate(self, timeout: float) -> None:
    self._timeout = timeout
    self._ending = None if self.waiting else self._host.end.remote(timeout)

  def wait(self) -> int | None:
    if self._ending is None:  # it never ran
      return 0
    try:
      return self._ray.get(self._ending, timeout=self._timeout + _GRACE)
    except (self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError) as error:
      self._report(f"{self._name} did not end in order: {type(error).__name__}.")
      return None

  def release(self) -> None:
    self._ray.kill(self._host, no_restart=True)


def train(
  settings: ClusterSettings,
  scripts: Scripts,
  *,
  forwarded: Sequence[str] = (),
  command: str = "",
) -> str:
  """Trains with processes that Ray places, and places again when a machine is lost.

  Args:
    settings: the run and its machines.
    scripts: of the processes, at the same path on all machines.
    forwarded: further arguments of the learner.
    command: what is noted as the command in launches.jsonl.

  Returns:
    Why the run failed; empty if it did not.

  Raises:
    RunRefusedError: the settings cannot be run, or there is no cluster.
  """
  tls = [settings.tls_certificate, settings.tls_key, settings.tls_authority]
  if any(tls) and not all(tls):
    raise RunRefusedError("--tls-certificate, --tls-key and --tls-authority belong together")
  settings = dataclasses.replace(settings, run=settings.run.absolute())
  training.check(settings)
  with training.locked(settings.run):
    ray = _connect(settings.address)
    try:
      return _train(ray, settings, scripts, forwarded, command)
    finally:
      ray.shutdown()


def _connect(address: str) -> Any:
  try:
    import ray
  except ImportError:
    raise RunRefusedError("Ray is missing: pip install '.[cluster]'") from None
  try:
    ray.init(
      address=None if address == "local" else address,
      log_to_driver=False,
      include_dashboard=False,
    )
  except ConnectionError as error:
    raise RunRefusedError(
      f"no Ray cluster at {address!r} ({error}): start one with `ray start --head`, or say "
      "--address local"
    ) from error
  return ray


def _train(
  ray: Any, settings: ClusterSettings, scripts: Scripts, forwarded: Sequence[str], command: str
) -> str:
  host = "127.0.0.1" if settings.address == "local" else ray.util.get_node_ip_address()
  passwords = {user: secrets.token_hex(16) for user in (_LEARNER, _ACTOR)}
  try:
    router, endpoint = _open_router(settings, host, passwords)
  except sessions.LinkError as error:
    raise RunRefusedError(str(error)) from error
  training.note_launch(settings.run, command)
  console = Console()

  def report(text: str) -> None:
    training.say(console, text)

  def start(job: Job) -> Process:
    return PlacedProcess(ray, job, report)

  report(f"Routing at {endpoint}.")
  learner, others = _jobs(settings, scripts, endpoint, passwords, forwarded)
  supervisor = Supervisor(
    start,
    learner,
    others,
    checkpoints=settings.run / "checkpoints",
    resume=settings.resume,
    restart_window=_RESTART_WINDOW,
    end_timeout=_END_TIMEOUT,
  )
  login = settings.run / "login.txt"
  training.write_private(login, f"{_ACTOR}:{passwords[_ACTOR]}\n")
  security = sessions.Security(login=login, tls_authority=settings.tls_authority)
  view = StatusView(str(settings.run), endpoint, sessions.LinkSettings(security=security))
  try:
    failure = training.supervise(supervisor, view, console)
  finally:
    view.close()
    sessions.close(router)
  if not failure:
    training.say_where(console, settings, supervisor)
  return failure


def _open_router(
  settings: ClusterSettings, host: str, passwords: dict[str, str]
) -> tuple[Any, str]:
  """Opens the run's router with passwords of its own; returns session and endpoint."""
  users = settings.run / "users.txt"
  training.write_private(users, "".join(f"{user}:{word}\n" for user, word in passwords.items()))
  endpoint = settings.listen
  if endpoint is None:
    kind = "tls" if settings.tls_certificate else "tcp"
    endpoint = f"{kind}/{host}:{training.free_port(host)}"
  security = sessions.Security(
    users=users, tls_certificate=settings.tls_certificate, tls_key=settings.tls_key
  )
  return sessions.route(endpoint, sessions.LinkSettings(security=security)), endpoint


def _jobs(
  settings: ClusterSettings,
  scripts: Scripts,
  endpoint: str,
  passwords: dict[str, str],
  forwarded: Sequence[str],
) -> tuple[Job, list[Job]]:
  """Returns the jobs with their logins and what they need of a machine."""
  common = ["--connect", endpoint, "--login", "{files}/login"]
  files = {}
  if settings.tls_authority is not None:
    common += ["--tls-authority", "{files}/authority"]
    files["authority"] = settings.tls_authority.read_text()
  learner, others = training.make_jobs(
    settings, scripts, learner=common, actor=common, forwarded=forwarded
  )
  resource = {settings.learner_resource: 1e-3} if settings.learner_resource else {}
  logins = {user: f"{user}:{password}\n" for user, password in passwords.items()}
  learner = dataclasses.replace(
    learner,
    files=files | {"login": logins[_LEARNER]},
    needs={
      "num_cpus": settings.learner_cpus,
      "num_gpus": settings.learner_gpus,
      "resources": resource,
    },
  )
  needs = {"num_cpus": settings.actor_cpus, "scheduling_strategy": "SPREAD"}
  own = files | {"login": logins[_ACTOR]}
  return learner, [dataclasses.replace(job, files=own, needs=needs) for job in others]
