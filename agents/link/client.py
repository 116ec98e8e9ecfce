"""The actor's end of the link: requests credits, sends trajectories until they are acknowledged.

Every call has a deadline. When no answer comes, the learner is away (killed, frozen, compiling its
machine's last core away): the actor waits and queries again, and keeps what it made.
"""

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import zenoh

from nerf2real.agents.link import schema
from nerf2real.agents.link.delivery import Outbox
from nerf2real.agents.link.schema import MessageError
from nerf2real.agents.link.sessions import LinkSettings
from nerf2real.agents.link.sessions import close as close_session

_PARAMETERS_TIMEOUT = 30.0  # s; 8 MB take 0.1 s


class Grant(dict[str, Any]):
  """The learner's answer: granted, acknowledged, version, steps, ending, stop, incarnation."""


class ActorLink:
  """Connects an actor or the evaluator to the learner."""

  def __init__(
    self,
    session: zenoh.Session,
    settings: LinkSettings,
    *,
    actor: str,
    role: str = "actor",
    resend_after: float = 5.0,
    ask_timeout: float = 3.0,
  ):
    """Joins.

    Args:
      session: from `sessions.connect`.
      settings: the link's settings.
      actor: a name that no other actor has or had.
      role: "actor", or "evaluator" for one that sends no trajectories.
      resend_after: time without an acknowledgement until a trajectory is sent again [s].
      ask_timeout: time to wait for the answer to a question [s].
    """
    self.actor = actor
    self.outbox = Outbox(resend_after=resend_after)
    self.version = -1  # of the parameters held
    self.incarnation = ""
    self._session = session
    self._prefix = settings.prefix
    self._ask_timeout = ask_timeout
    # BLOCK: a full queue makes put wait instead of losing data; see sessions.py for how long.
    self._publisher = session.declare_publisher(
      f"{self._prefix}/trajectory/{actor}", congestion_control=zenoh.CongestionControl.BLOCK
    )
    self._metrics = session.declare_publisher(
      f"{self._prefix}/metrics/{actor}", congestion_control=zenoh.CongestionControl.BLOCK
    )
    self._token = session.liveliness().declare_token(f"{self._prefix}/alive/{role}/{actor}")

  @property
  def learner_is_there(self) -> bool:
    """Whether something receives this actor's trajectories now."""
    status: Any = self._publisher.matching_status  # bool in zenoh's type stub
    return bool(status.matching)

  def ask(
    self, question: str, message: bytes, *, kind: str, timeout: float | None = None
  ) -> schema.Message | None:
    """Sends a query to the learner; returns its answer, None if none comes in time.

    Raises:
      MessageError: if the learner refuses the question or answers with something else.
    """
    replies = self._session.get(
      f"{self._prefix}/ask/{question}", payload=message, timeout=timeout or self._ask_timeout
    )
    for reply in replies:
      if reply.ok is not None:
        return schema.decode(reply.ok.payload.to_bytes(), kind=kind)
      reason = reply.err.payload.to_bytes().decode(errors="replace") if reply.err else ""
      if "imeout" not in reason and reason:
        raise MessageError(f"The learner refused {question!r}: {reason}")
    return None

  def request(self, wanted: int, *, held: int = 0) -> Grant | None:
    """Requests credits and acknowledgements; returns None if the learner is away.

    Args:
      wanted: environment steps to be granted.
      held: steps granted before and not sent yet; what waits in the outbox is added.
    """
    values = {
      "actor": self.actor,
      "wanted": wanted,
      "held": held + self.outbox.steps,
      "version": max(self.version, 0),
      "oldest": self.outbox.oldest,
    }
    message = self.ask("credit", schema.encode("credit", values), kind="grant")
    if message is None:
      return None
    grant = Grant(message.values)
    if grant["incarnation"] != self.incarnation:  # a learner that has not seen what was sent
      self.incarnation = grant["incarnation"]
      self.outbox.forget_sent()
    self.outbox.acknowledge(grant["acknowledged"])
    return grant

  def send(self, trajectory: Mapping[str, np.ndarray], *, steps: int) -> None:
    """Puts a trajectory of some environment steps into the outbox and sends what is due."""
    values = {"actor": self.actor, "number": self.outbox.made + 1, "steps": steps}
    self.outbox.add(schema.encode("trajectory", values, trajectory), steps)
    self.flush()

  def flush(self) -> None:
    """Sends what is due, if something is there to receive it."""
    if not self.learner_is_there:
      return
    for pending in self.outbox.due(time.monotonic()):
      self._publisher.put(pending.payload)

  def drain(self, *, timeout: float) -> bool:
    """Waits until all is acknowledged; returns whether it was within `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while self.outbox.size and time.monotonic() < deadline:
      self.flush()
      self.request(0)
      time.sleep(0.02)
    return not self.outbox.size

  def parameters(self, *, hold: bool = False) -> tuple[int, dict[str, np.ndarray]] | None:
    """Fetches the present parameters and their version; None if the learner has none or is away.

    Args:
      hold: whether the learner keeps them, to save them if they turn out to be the best.
    """
    question = schema.encode("ask", {"hold": hold})
    message = self.ask("parameters", question, kind="parameters", timeout=_PARAMETERS_TIMEOUT)
    if message is None or message.values.get("version") == -1:
      return None
    self.version = schema.integer(message, "version")
    return self.version, message.arrays

  def status(self) -> dict[str, Any] | None:
    """Requests the learner's status, its description and this actor's predecessors.

    Returns None if the learner is away.
    """
    question = schema.encode("ask", {"actor": self.actor})
    message = self.ask("status", question, kind="status")
    return None if message is None else message.values

  def report(self, values: Mapping[str, Any]) -> None:
    """Sends metrics, null for a number that is not finite; they are lost without a learner."""
    finite = {
      name: None if isinstance(value, float) and not math.isfinite(value) else value
      for name, value in values.items()
    }
    self._metrics.put(schema.encode("metrics", {"who": self.actor, **finite}))

  def close(self) -> None:
    """Leaves."""
    for entity in (self._token, self._publisher, self._metrics):
      entity.undeclare()
    close_session(self._session)
