"""Exactly-once delivery of trajectories: numbering, resending, acknowledgement.

zenoh's put does not report whether data arrived: it vanishes while no learner is there, and after a
transport was closed. So an actor numbers its trajectories from 1 and keeps each until it is
acknowledged; what stays unacknowledged is sent again. The learner drops what it has already. Pure
accounting: no network, no threads; time is passed in.
"""

import collections
from typing import NamedTuple


class Pending(NamedTuple):
  """A trajectory that is not acknowledged yet."""

  number: int
  payload: bytes
  steps: int


class Outbox:
  """What an actor has made and the learner has not acknowledged, oldest first."""

  def __init__(self, *, resend_after: float):
    """Creates an empty outbox.

    Args:
      resend_after: time without an acknowledgement until a trajectory is sent again [s].
    """
    self._resend_after = resend_after
    self._pending: collections.OrderedDict[int, Pending] = collections.OrderedDict()
    self._sent_at: dict[int, float] = {}
    self.made = 0
    self.resent = 0

  @property
  def steps(self) -> int:
    """Environment steps in it."""
    return sum(p.steps for p in self._pending.values())

  @property
  def size(self) -> int:
    """Trajectories in it."""
    return len(self._pending)

  @property
  def oldest(self) -> int:
    """The oldest number that is not acknowledged; the next one to be made if there is none."""
    return next(iter(self._pending), self.made + 1)

  def add(self, payload: bytes, steps: int) -> Pending:
    """Adds a trajectory and gives it its number: the payload is made for `made + 1`."""
    self.made += 1
    self._pending[self.made] = Pending(self.made, payload, steps)
    return self._pending[self.made]

  def acknowledge(self, up_to: int) -> None:
    """Removes all numbers up to and including `up_to`."""
    while self._pending and next(iter(self._pending)) <= up_to:
      number, _ = self._pending.popitem(last=False)
      self._sent_at.pop(number, None)

  def forget_sent(self) -> None:
    """Says that nothing was sent yet: the learner is another one than before."""
    self._sent_at.clear()

  def due(self, now: float) -> list[Pending]:
    """What to send now: never sent, or sent too long ago. Counts as sent at once."""
    result = []
    for number, pending in self._pending.items():
      sent = self._sent_at.get(number)
      if sent is not None and now - sent < self._resend_after:
        continue
      self.resent += sent is not None
      self._sent_at[number] = now
      result.append(pending)
    return result


class Ledger:
  """What the learner has of each actor."""

  def __init__(self) -> None:
    self._contiguous: dict[int, int] = {}  # actor's key -> all up to this number are here
    self._beyond: dict[int, set[int]] = {}  # numbers above, that came before their predecessors

  def seen(self, actor: int, number: int) -> bool:
    """Whether a trajectory is here already."""
    return number <= self._contiguous.get(actor, 0) or number in self._beyond.get(actor, ())

  def record(self, actor: int, number: int) -> None:
    """Records that a trajectory is here."""
    self._beyond.setdefault(actor, set()).add(number)
    self.confirm(actor, oldest=1)

  def confirm(self, actor: int, *, oldest: int) -> None:
    """Takes the actor's word that all before `oldest` is acknowledged, if by a former learner."""
    top, beyond = self._contiguous.get(actor, 0), self._beyond.setdefault(actor, set())
    if oldest - 1 > top:
      top = oldest - 1
      beyond.difference_update([n for n in beyond if n <= top])
    while top + 1 in beyond:
      top += 1
      beyond.remove(top)
    self._contiguous[actor] = top

  def acknowledged(self, actor: int) -> int:
    """All numbers up to this one are here."""
    return self._contiguous.get(actor, 0)

  def gaps(self, actor: int) -> int:
    """Numbers missing below the highest that arrived."""
    beyond = self._beyond.get(actor)
    if not beyond:
      return 0
    return max(beyond) - self._contiguous.get(actor, 0) - len(beyond)
