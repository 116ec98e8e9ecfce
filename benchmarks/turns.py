"""Times calls that take turns; percentiles of what was measured."""

import dataclasses
import gc
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def percentile(values: Sequence[float], share: float) -> float:
  """Returns a percentile (0 to 100) of values, interpolated linearly."""
  ranked = sorted(values)
  place = (len(ranked) - 1) * share / 100
  below = int(place)
  above = min(below + 1, len(ranked) - 1)
  return ranked[below] + (place - below) * (ranked[above] - ranked[below])


@dataclasses.dataclass
class Times:
  """Durations of one call, repeated [s]."""

  elapsed: list[float] = dataclasses.field(default_factory=list)
  processor: list[float] = dataclasses.field(default_factory=list)

  def figures(self, *, per: int = 1) -> dict[str, float]:
    """Returns median, p95 and longest by the clock, and median by processor time.

    Args:
      per: Units of work in a call; times are for one of them.
    """
    elapsed = [1e3 * value / per for value in self.elapsed]
    processor = [1e3 * value / per for value in self.processor]
    return {
      "median_ms": percentile(elapsed, 50),
      "p95_ms": percentile(elapsed, 95),
      "longest_ms": max(elapsed),
      "processor_median_ms": percentile(processor, 50),
      "processor_p95_ms": percentile(processor, 95),
    }

  def rate(self, *, per: int = 1) -> float:
    """Returns units of work a second of all calls together."""
    return per * len(self.elapsed) / sum(self.elapsed)


def interleave(
  calls: Mapping[str, Callable[[int], Any]],
  *,
  rounds: int,
  warm_up: int = 1,
  limits: Mapping[str, int] | None = None,
  seconds: float | None = None,
) -> dict[str, Times]:
  """Times calls that take turns, so that they see the same machine.

  Args:
    calls: By name; each gets the number of the round.
    rounds: Turns of every call.
    warm_up: Turns before them that are not counted (compilation, caches).
    limits: Fewer turns for slow calls, by name.
    seconds: Stop once every call has had so much time, where that comes before `rounds`.
  """
  times = {name: Times() for name in calls}
  for _ in range(warm_up):
    for call in calls.values():
      call(0)
  gc.collect()
  for index in range(rounds):
    for name, call in calls.items():
      if index >= (limits or {}).get(name, rounds):
        continue
      begin, begin_processor = time.perf_counter(), time.process_time()
      call(index)
      times[name].processor.append(time.process_time() - begin_processor)
      times[name].elapsed.append(time.perf_counter() - begin)
    if seconds is not None and min(sum(t.elapsed) for t in times.values()) >= seconds:
      break
  return times
