"""Where the time of a loop goes: seconds by stage, given out as milliseconds for each turn."""

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
