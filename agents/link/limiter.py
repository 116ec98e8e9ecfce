"""The rate limiter: how many environment steps may be taken, and when an update is due.

Credits are environment steps. An actor requests some before it takes them; what it was granted and
has not delivered yet is outstanding, and returns to the pool when the actor is gone. Steps that
fill the replay pay for no update, as in Reverb's SampleToInsertRatio with Acme's offset:
updates = floor((steps - unpaid) / steps_per_update), so that training begins at the ratio and not
with a burst on the first data. Actors may run ahead of the updates by two trajectories each.
Credits are granted for what a whole trajectory still needs or not at all, so that no actor is left
waiting in the middle of one. Pure accounting: no threads, no clock.
"""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class LimiterSettings:
  """Settings of the rate limiter; all in environment steps."""

  steps_per_update: float
  """Steps that pay for one update. Paper: 8."""
  min_replay_steps: int
  """Steps in the replay before the first update."""
  trajectory_steps: int
  """Steps of a whole trajectory."""
  max_steps: int | None = None
  """Steps of the whole run; None: no end."""


class RateLimiter:
  """Counts steps, updates and credits."""

  def __init__(
    self,
    settings: LimiterSettings,
    *,
    steps: int = 0,
    updates: int = 0,
    refill_until: int | None = None,
    unpaid: float | None = None,
  ):
    """Starts a run, or continues one.

    Args:
      settings: the limiter's settings.
      steps: environment steps that reached the replay.
      updates: updates done.
      refill_until: number of steps at which the replay was, or will be, filled; None for a new run.
      unpaid: steps that pay for no update, less those of updates without payment; None for a new
        run.
    """
    self.settings = settings
    self.steps = steps
    self.updates = updates
    self.refill_until = settings.min_replay_steps if refill_until is None else refill_until
    self.unpaid: float = settings.min_replay_steps if unpaid is None else unpaid
    self._outstanding: dict[str, int] = {}

  @property
  def outstanding(self) -> int:
    """Steps granted and not delivered yet."""
    return sum(self._outstanding.values())

  @property
  def lead(self) -> int:
    """Steps that the actors may be ahead of the updates: two trajectories each, and two more."""
    return 2 * self.settings.trajectory_steps * (len(self._outstanding) + 1) + int(
      self.settings.steps_per_update
    )

  @property
  def ending(self) -> bool:
    """Whether the run's last steps are granted or taken: actors give out what they have."""
    end = self.settings.max_steps
    return end is not None and self.steps + self.outstanding >= end

  @property
  def limit(self) -> int:
    """Steps that may be taken until further updates are done."""
    paid = self.unpaid + self.updates * self.settings.steps_per_update
    limit = max(self.refill_until, int(paid)) + self.lead
    return limit if self.settings.max_steps is None else min(limit, self.settings.max_steps)

  @property
  def filled(self) -> bool:
    """Whether the replay holds enough for updates, or the run ends before it would."""
    end = self.settings.max_steps
    return self.steps >= (self.refill_until if end is None else min(self.refill_until, end))

  @property
  def update_due(self) -> bool:
    """Whether an update may be done now."""
    paid = self.unpaid + (self.updates + 1) * self.settings.steps_per_update
    return self.filled and paid <= self.steps

  @property
  def finished(self) -> bool:
    """Whether all steps of the run were taken and paid for."""
    end = self.settings.max_steps
    return end is not None and self.steps >= end and not self.update_due

  def refill(self, held: int) -> None:
    """Waits for a replay to fill again that holds only `held` steps when a run is continued."""
    until = self.steps + max(0, self.settings.min_replay_steps - held)
    self.unpaid += max(0, until - max(self.steps, self.refill_until))
    self.refill_until = max(self.refill_until, until)

  def request(self, actor: str, wanted: int, *, held: int) -> int:
    """Grants up to `wanted` steps to an actor that holds `held` unspent or undelivered."""
    # The actor's own count is the truth: a reply may have been lost on the way.
    self._outstanding[actor] = held
    room = self.limit - self.steps - self.outstanding
    last = self.settings.max_steps is not None and self.limit >= self.settings.max_steps
    granted = wanted if room >= wanted else max(0, room) if last else 0
    self._outstanding[actor] = held + granted
    return granted

  def delivered(self, actor: str, steps: int) -> None:
    """Counts steps that reached the replay."""
    self.steps += steps
    self.returned(actor, steps)

  def returned(self, actor: str, steps: int) -> None:
    """Returns credits to the pool that an actor spent: on delivered steps, or on refused ones."""
    if actor in self._outstanding:
      self._outstanding[actor] = max(0, self._outstanding[actor] - steps)

  def updated(self, *, paid: bool = True) -> None:
    """Counts an update; one that is not paid for neither requests steps nor gives credits."""
    self.updates += 1
    if not paid:
      self.unpaid -= self.settings.steps_per_update

  def forget(self, actor: str) -> None:
    """Returns an actor's credits to the pool: it is gone."""
    self._outstanding.pop(actor, None)
