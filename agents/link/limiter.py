"""The rate limiter: how many environment steps may be taken, and when an update is due.

Credits are environment steps. An actor asks for some before it takes them; what it was granted and
has not delivered yet is outstanding, and returns to the pool when the actor is gone. Updates follow
steps as updates = floor(steps / steps_per_update), so that over a run the ratio is exact; actors
may run ahead of the updates by two trajectories each. Credits are granted for what a whole
trajectory still needs or not at all, so that no actor is left waiting in the middle of one. Pure
accounting: no threads, no clock.
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

  def __init__(self, settings: LimiterSettings, *, steps: int = 0, updates: int = 0):
    """Continues from `steps` and `updates` done."""
    self.settings = settings
    self.steps = steps  # environment steps that reached the replay
    self.updates = updates
    self._outstanding: dict[str, int] = {}
    # A replay that was not saved must fill again before updates go on.
    self.refill_until = steps + settings.min_replay_steps if steps else settings.min_replay_steps

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
    paid = self.updates * self.settings.steps_per_update
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
    return self.filled and (self.updates + 1) * self.settings.steps_per_update <= self.steps

  @property
  def finished(self) -> bool:
    """Whether all steps of the run were taken and paid for."""
    end = self.settings.max_steps
    return end is not None and self.steps >= end and not self.update_due

  def already_filled(self) -> None:
    """Says that the replay was restored with enough in it."""
    self.refill_until = min(self.refill_until, self.steps)

  def request(self, actor: str, wanted: int, *, held: int) -> int:
    """Grants up to `wanted` steps to an actor that says it holds `held` unspent or undelivered."""
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
    if actor in self._outstanding:
      self._outstanding[actor] = max(0, self._outstanding[actor] - steps)

  def updated(self) -> None:
    """Counts an update."""
    self.updates += 1

  def forget(self, actor: str) -> None:
    """Returns an actor's credits to the pool: it is gone."""
    self._outstanding.pop(actor, None)
