"""Delay lines: samples that are read later than they were taken.

`History` keeps samples with their times and gives the newest up to a time, or interpolates;
`DelayLine` is one whose samples arrive late, with jitter; `StepRing` keeps an array that changes
once a fixed step. They use nothing of the simulator.
"""

import math
from collections.abc import Iterator

import numpy as np

Array = np.ndarray

_EPSILON = 1e-9  # s, against rounding in sums of time steps


class History:
  """The last samples of a channel with their times, in a ring."""

  def __init__(self, capacity: int = 64):
    """Keeps up to `capacity` samples, arrays of one shape."""
    self._times = [0.0] * capacity
    self._values: Array | None = None
    self.count = 0
    """Samples pushed so far."""

  def clear(self) -> None:
    """Clears the queue."""
    self.count = 0

  @property
  def last_time(self) -> float:
    """Time of the sample pushed last [s]; minus infinity before the first."""
    return self._times[(self.count - 1) % len(self._times)] if self.count else -math.inf

  def push(self, time: float, value: Array) -> None:
    """Adds a sample of a time [s]; one of the last sample's time replaces it."""
    if self._values is None or self._values.shape[1:] != np.shape(value):
      value = np.asarray(value)
      self._values = np.empty((len(self._times), *value.shape), value.dtype)
      self.count = 0
    if time != self.last_time:
      self.count += 1
    slot = (self.count - 1) % len(self._times)
    self._times[slot], self._values[slot] = time, value

  def newest(self, time: float) -> Array:
    """Returns a copy of the sample pushed last of those up to `time` [s]; the oldest if none is.

    Raises:
      ValueError: Nothing was pushed.
    """
    for slot in self._slots():
      if self._times[slot] <= time + _EPSILON:
        break
    assert self._values is not None
    return self._values[slot].copy()

  def interpolate(self, time: float) -> Array:
    """Returns the value at `time` [s], linear between samples, the nearest outside them.

    Raises:
      ValueError: Nothing was pushed.
    """
    times, values = self._times, self._values
    later: int | None = None
    for slot in self._slots():
      if times[slot] < time:
        break
      later = slot
    assert values is not None
    if later is None or later == slot:  # after the last sample, or before the oldest
      return values[slot].copy()
    weight = (time - times[slot]) / (times[later] - times[slot])
    return values[slot] + weight * (values[later] - values[slot])

  def _slots(self) -> Iterator[int]:
    """Yields the places of the samples kept, the last one first."""
    if not self.count:
      raise ValueError("Found an empty delay line, expected a push before the first read.")
    size = len(self._times)
    for index in range(self.count - 1, max(0, self.count - size) - 1, -1):
      yield index % size


class DelayLine:
  """Samples that arrive late: by a constant delay, and uniform jitter drawn for each."""

  def __init__(self, delay: float = 0.0, *, jitter: float = 0.0, capacity: int = 64):
    """Creates a delay line.

    Args:
      delay: s.
      jitter: Half width of the uniform jitter, s.
      capacity: Samples kept; at least (delay + jitter) * sampling rate + 2.
    """
    self._arrived = History(capacity)
    self._rng = np.random.default_rng(0)
    self.reset(delay, jitter=jitter)

  def reset(
    self, delay: float, *, jitter: float = 0.0, rng: np.random.Generator | None = None
  ) -> None:
    """Empties the line for a new episode with its own delay [s], jitter [s] and random stream."""
    if delay < 0 or jitter < 0:
      raise ValueError(f"Found delay {delay} s and jitter {jitter} s, expected both at least 0.")
    self.delay, self.jitter = delay, jitter
    if rng is not None:
      self._rng = rng
    self._arrived.clear()

  def push(self, time: float, value: Array) -> None:
    """Adds the sample taken at `time` [s]; times must not decrease."""
    lateness = self.delay
    if self.jitter:
      lateness = max(0.0, lateness + self.jitter * (2 * self._rng.random() - 1))
    self._arrived.push(time + lateness, value)

  def read(self, time: float) -> Array:
    """Returns a copy of the newest sample that has arrived by `time` [s]; the oldest if none has.

    Raises:
      ValueError: Nothing was pushed.
    """
    return self._arrived.newest(time)


class StepRing:
  """The last values of an array [N] that changes once a fixed step."""

  def __init__(self, steps: int, size: int):
    """Keeps the values of `steps` steps, of `size` numbers each, zero so far."""
    self._rows = np.zeros((steps, size))
    self._columns = np.arange(size)
    self._now = 0

  def __len__(self) -> int:
    return len(self._rows)

  def fill(self, value: Array) -> None:
    """Takes `value` [N] for all steps."""
    self._rows[:] = value

  def push(self, value: Array) -> None:
    """Adds the value [N] of the next step."""
    self._now = (self._now + 1) % len(self._rows)
    self._rows[self._now] = value

  def back(self, steps: int) -> Array:
    """Returns a view of the value [N] some steps ago, fewer than are kept; 0 is the last one."""
    return self._rows[(self._now - steps) % len(self._rows)]

  def back_each(self, steps: Array) -> Array:
    """Returns the value [N] of which each number is its own count of steps [N] old."""
    return self._rows[(self._now - steps) % len(self._rows), self._columns]
