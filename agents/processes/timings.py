"""Times of a process: seconds by stage of its loop, rates of its counters, periodical work."""

import collections
import contextlib
import time
from collections.abc import Iterator


class StageTimes:
  """Sums the time that a loop spends in its stages."""

  def __init__(self) -> None:
    self._seconds: collections.defaultdict[str, float] = collections.defaultdict(float)

  @contextlib.contextmanager
  def stage(self, name: str) -> Iterator[None]:
    """Counts the time of a block to a stage."""
    begin = time.perf_counter()
    try:
      yield
    finally:
      self._seconds[name] += time.perf_counter() - begin

  def move(self, seconds: float, *, source: str, to: str) -> None:
    """Counts time to another stage than the one whose block it was spent in."""
    self._seconds[source] -= seconds
    self._seconds[to] += seconds

  def take(self, turns: int) -> dict[str, float]:
    """Returns {"<stage>_ms": time for each turn} and begins anew."""
    found = {f"{name}_ms": 1e3 * s / max(turns, 1) for name, s in self._seconds.items()}
    self._seconds.clear()
    return found


class Rates:
  """Steps and updates a second, over the last 60 measurements."""

  def __init__(self, steps: int, updates: int):
    """Begins with the counters' present values."""
    self._points = collections.deque([(time.monotonic(), steps, updates)], maxlen=60)

  def measure(self, steps: int, updates: int) -> dict[str, float]:
    """Returns `steps_per_second` and `updates_per_second` up to the counters' present values."""
    now = time.monotonic()
    self._points.append((now, steps, updates))
    begin, first_steps, first_updates = self._points[0]
    span = max(now - begin, 1e-3)
    return {
      "steps_per_second": (steps - first_steps) / span,
      "updates_per_second": (updates - first_updates) / span,
    }


class Periods:
  """When periodical work of a loop is due, by name."""

  def __init__(self) -> None:
    self._last: dict[str, float] = {}

  def due(self, name: str, period: float) -> bool:
    """Returns whether the period [s] is over since it last was; it begins with the first call."""
    now = time.monotonic()
    if now - self._last.setdefault(name, now) < period:
      return False
    self._last[name] = now
    return True

  def restart(self, name: str) -> None:
    """Begins a period anew, such as after work that was done early."""
    self._last[name] = time.monotonic()
