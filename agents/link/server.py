"""The learner's end of the link: receives trajectories, answers questions, counts everything.

zenoh's callbacks only enqueue bytes (trajectories, metrics) or answer from a few numbers (credits)
and from bytes prepared beforehand (parameters); none waits for the accelerator. A thread of this
class decodes, checks and hands trajectories to `insert`.

Keys below the prefix: `trajectory/<actor>`, `metrics/<who>`, `ask/credit`, `ask/parameters`,
`ask/status`, `alive/actor/<id>`, `alive/learner`.
"""

import dataclasses
import hashlib
import logging
import queue
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import zenoh

from nerf2real.agents.link import schema
from nerf2real.agents.link.delivery import Ledger
from nerf2real.agents.link.limiter import RateLimiter
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.link.sessions import LinkSettings

_log = logging.getLogger(__name__)
# Versions kept for the evaluator: when it reports a best return, they are still here to be saved.
_HELD_VERSIONS = 4

Insert = Callable[[Mapping[str, np.ndarray], int, int], int]


@dataclasses.dataclass
class ActorRecord:
  """The learner's record of an actor."""

  alive: bool = True
  parameters_version: int = 0
  refused: int = 0
  """Trajectories that did not fit the replay."""


@dataclasses.dataclass
class Counters:
  """What passed the link since this learner started."""

  trajectories: int = 0
  bytes: int = 0
  refused: int = 0
  duplicates: int = 0
  last_refusal: str = ""


def actor_key(actor: str) -> int:
  """A number for an actor's name, as the replay stores it."""
  return int.from_bytes(hashlib.blake2b(actor.encode(), digest_size=8).digest(), "little") >> 1


class LearnerLink:
  """Serves actors and the evaluator over a session."""

  def __init__(
    self,
    session: zenoh.Session,
    settings: LinkSettings,
    *,
    limiter: RateLimiter,
    insert: Insert,
    description: Mapping[str, Any],
    known: list[tuple[int, int]] | None = None,
  ):
    """Starts serving.

    Args:
      session: from `sessions.listen`.
      settings: the link's settings.
      limiter: the run's rate limiter; use it under `lock` only.
      insert: puts (trajectory, actor's key, number) into the replay and returns its environment
        steps; raises ValueError for one that does not fit.
      description: of the run, for its actors: environment, settings.
      known: (actor's key, number) of trajectories that the replay holds already.
    """
    self.lock = threading.Lock()
    self.taking = threading.Lock()
    """Held, before `lock`, from a trajectory's insertion until its steps are counted."""
    self.limiter = limiter
    self.counters = Counters()
    self.failure = ""  # why nothing is taken in any more; empty while all is well
    self.incarnation = uuid.uuid4().hex
    self._insert = insert
    self._session = session  # a session without a reference closes itself
    self._prefix = settings.prefix
    self._description = dict(description)
    self._ledger = Ledger()
    for key, number in known or []:
      self._ledger.record(key, number)
    self._actors: dict[str, ActorRecord] = {}
    self._parameters = b""
    self._held: dict[int, bytes] = {}  # versions that the evaluator fetched
    self._version = 0
    self._published = time.monotonic()
    self._status: dict[str, Any] = {}
    self._stopping = False
    self._inbox: queue.SimpleQueue[tuple[str, bytes] | None] = queue.SimpleQueue()
    self.metrics: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()
    self._thread = threading.Thread(target=self._ingest, name="ingest", daemon=True)
    self._thread.start()
    at = self._key
    self._entities: list[Any] = [
      session.declare_subscriber(at("trajectory/*"), self._on_message("trajectory")),
      session.declare_subscriber(at("metrics/*"), self._on_message("metrics")),
      session.declare_queryable(at("ask/credit"), self._answering(self._answer_credit)),
      session.declare_queryable(at("ask/parameters"), self._answering(self._answer_parameters)),
      session.declare_queryable(at("ask/status"), self._answering(self._answer_status)),
      session.liveliness().declare_subscriber(
        at("alive/actor/*"), self._on_liveliness, history=True
      ),
      session.liveliness().declare_token(at("alive/learner")),
    ]

  def _key(self, rest: str) -> str:
    return f"{self._prefix}/{rest}"

  # ------------------------------------------------------------ what the learner calls

  def publish_parameters(self, arrays: Mapping[str, np.ndarray], *, version: int) -> None:
    """Serves parameters to all processes; `version` grows (updates done)."""
    data = schema.encode("parameters", {"version": version}, arrays)
    with self.lock:
      self._parameters, self._version, self._published = data, version, time.monotonic()

  def held_parameters(self, version: int) -> dict[str, np.ndarray] | None:
    """The parameters of a version that the evaluator fetched lately; None if they are gone."""
    with self.lock:
      data = self._held.get(version)
    return None if data is None else schema.decode(data, kind="parameters").arrays

  def set_status(self, status: Mapping[str, Any]) -> None:
    """Sets what `ask/status` answers, besides the link's own figures."""
    with self.lock:
      self._status = dict(status)

  def take_metrics(self) -> list[tuple[str, dict[str, Any]]]:
    """Returns the figures that came in since the last call, with their senders' names."""
    return [self.metrics.get() for _ in range(self.metrics.qsize())]

  def stop_actors(self) -> None:
    """Ends the run for the actors: `stop` in all grants from now on."""
    with self.lock:
      self._stopping = True

  def alive(self) -> list[str]:
    """Names of the actors that are alive."""
    with self.lock:
      return sorted(name for name, record in self._actors.items() if record.alive)

  def figures(self) -> dict[str, Any]:
    """The link's counters and what is outstanding."""
    with self.lock:
      return self._figures()

  def _figures(self) -> dict[str, Any]:
    counters = dataclasses.asdict(self.counters)
    return counters | {
      "queue": self._inbox.qsize(),
      # A hole in a living actor's numbers will be filled; a dead one's will not.
      "gaps": self._gaps(alive=True),
      "dropped": self._gaps(alive=False),
      "actors": sum(r.alive for r in self._actors.values()),
      "outstanding": self.limiter.outstanding,
      "parameters_version": self._version,
      "parameters_age": time.monotonic() - self._published,
      # Updates that the slowest living actor is behind the newest parameters.
      "parameters_lag": max(
        (self._version - r.parameters_version for r in self._actors.values() if r.alive), default=0
      ),
    }

  def _gaps(self, *, alive: bool) -> int:
    return sum(
      self._ledger.gaps(actor_key(name)) for name, r in self._actors.items() if r.alive == alive
    )

  def close(self) -> None:
    """Stops serving after what has arrived is in the replay."""
    for entity in self._entities:
      entity.undeclare()
    self._inbox.put(None)
    self._thread.join(timeout=10)

  # ------------------------------------------------------------ callbacks: enqueue or answer

  def _on_message(self, kind: str) -> Callable[[zenoh.Sample], None]:
    def receive(sample: zenoh.Sample) -> None:
      self._inbox.put((kind, sample.payload.to_bytes()))

    return receive

  def _on_liveliness(self, sample: zenoh.Sample) -> None:
    actor = str(sample.key_expr).rpartition("/")[2]
    with self.lock:
      if sample.kind == zenoh.SampleKind.PUT:
        self._record(actor)
        return
      record = self._actors.get(actor)
      if record is not None:
        record.alive = False
        # What it was granted returns to the pool, holes in its numbering stay holes.
        self.limiter.forget(actor)

  def _record(self, actor: str) -> ActorRecord:
    record = self._actors.setdefault(actor, ActorRecord())
    record.alive = True
    return record

  def _answering(self, answer: Callable[[schema.Message], bytes]) -> Callable[[zenoh.Query], None]:
    def reply(query: zenoh.Query) -> None:
      try:
        payload = query.payload
        message = schema.decode(payload.to_bytes() if payload is not None else b"")
        query.reply(query.key_expr, answer(message))
      except MessageError as error:
        self._refuse(str(error))
        query.reply_err(str(error).encode())
      except zenoh.ZError:
        pass  # the querying process is gone; it queries again if it comes back
      finally:
        query.drop()  # otherwise the asker waits for further answers until its deadline

    return reply

  def _answer_credit(self, message: schema.Message) -> bytes:
    if message.kind != "credit":
      raise MessageError(f"Expected a message of kind 'credit', found {message.kind!r}.")
    actor = schema.text(message, "actor")
    wanted = schema.integer(message, "wanted", high=1_000_000)
    held = schema.integer(message, "held", high=100_000_000)
    version = schema.integer(message, "version")
    oldest = schema.integer(message, "oldest", low=1)
    with self.lock:
      self._ledger.confirm(actor_key(actor), oldest=oldest)
      granted = 0
      # The evaluator requests no steps: only what has been reached.
      acts = wanted + held > 0 or actor in self._actors
      if acts:
        self._record(actor).parameters_version = version
      if acts and not self._stopping:
        granted = self.limiter.request(actor, wanted, held=held)
      values = {
        "granted": granted,
        "acknowledged": self._ledger.acknowledged(actor_key(actor)),
        "version": self._version,
        "steps": self.limiter.steps,
        "ending": self.limiter.ending,
        "stop": self._stopping or self.limiter.finished,
        "incarnation": self.incarnation,
      }
    return schema.encode("grant", values)

  def _answer_parameters(self, message: schema.Message) -> bytes:
    with self.lock:
      if not self._parameters:
        return schema.encode("parameters", {"version": -1})
      if message.values.get("hold") is True:
        self._held[self._version] = self._parameters
        while len(self._held) > _HELD_VERSIONS:
          del self._held[min(self._held)]
      return self._parameters

  def _answer_status(self, message: schema.Message) -> bytes:
    actor = message.values.get("actor")
    with self.lock:
      refused = {name: r.refused for name, r in self._actors.items() if r.refused}
      values = {
        "status": self._status | self._figures() | {"refused_by": refused},
        "description": self._description,
        "predecessors": self._predecessors(actor) if isinstance(actor, str) else 0,
      }
    return schema.encode("status", values)

  def _predecessors(self, actor: str) -> int:
    """How many actors of the same number (role-number-...) were here before this one."""
    place = actor.rpartition("-")[0]
    return sum(name != actor and name.rpartition("-")[0] == place for name in self._actors)

  # ------------------------------------------------------------ the ingest thread

  def _refuse(self, reason: str) -> None:
    with self.lock:
      self.counters.refused += 1
      self.counters.last_refusal = reason[:500]
      count = self.counters.refused
    if count & (count - 1) == 0:  # the first, second, fourth, ...: a flood does not fill the log
      _log.warning("Refused a message (number %d): %s", count, reason)

  def _ingest(self) -> None:
    try:
      while (item := self._inbox.get()) is not None:
        kind, data = item
        try:
          if kind == "trajectory":
            self._take_trajectory(data)
          else:
            message = schema.decode(data, kind="metrics")
            self.metrics.put((schema.text(message, "who"), message.values))
        except MessageError as error:
          self._refuse(str(error))
    except Exception as error:  # such as a full disk: the learner must end, not stand still
      _log.exception("Trajectories can no longer be taken in.")
      self.failure = f"{type(error).__name__}: {error}"

  def _take_trajectory(self, data: bytes) -> None:
    message = schema.decode(data, kind="trajectory")
    actor = schema.text(message, "actor")
    number = schema.integer(message, "number", low=1)
    claimed = schema.integer(message, "steps")
    key = actor_key(actor)
    with self.lock:
      if self._ledger.seen(key, number):
        self.counters.duplicates += 1
        return
    with self.taking:
      try:
        steps = self._insert(message.arrays, key, number)
      except ValueError as error:
        self._drop(actor, number, claimed)
        self._refuse(f"trajectory {number} of {actor}: {error}")
        return
      with self.lock:
        self._ledger.record(key, number)
        self.limiter.delivered(actor, steps)
        self.counters.trajectories += 1
        self.counters.bytes += len(data)

  def _drop(self, actor: str, number: int, steps: int) -> None:
    """Acknowledges a trajectory that does not fit, so that its actor does not send it for ever."""
    with self.lock:
      self._ledger.record(actor_key(actor), number)
      self.limiter.returned(actor, steps)
      unknown = ActorRecord(alive=False)
      self._actors.setdefault(actor, unknown).refused += 1
