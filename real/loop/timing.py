"""Timing statistics of the control loop: durations, ages of observations, missed deadlines."""

import collections
from collections.abc import Mapping

import numpy as np

_KEPT = 100_000  # newest values of each quantity: 40 minutes of control steps


class Timing:
  """Collects durations and ages [s] by name, and counts by name."""

  def __init__(self) -> None:
    self.values: dict[str, collections.deque[float]] = {}
    self.counts: collections.Counter[str] = collections.Counter()

  def add(self, name: str, seconds: float) -> None:
    """Notes a value."""
    found = self.values.get(name)
    if found is None:
      found = self.values[name] = collections.deque(maxlen=_KEPT)
    found.append(seconds)

  def count(self, name: str, number: int = 1) -> None:
    """Counts events."""
    self.counts[name] += number

  def reset(self) -> None:
    """Clears the measurements."""
    self.values.clear()
    self.counts.clear()

  def summary(self) -> dict[str, Mapping[str, float]]:
    """Returns median, 99th percentile and maximum [s] of every quantity that has values."""
    return {
      name: {
        "median": float(np.median(found)),
        "p99": float(np.percentile(found, 99)),
        "max": float(np.max(found)),
        "number": float(len(found)),
      }
      for name, found in ((name, np.array(values)) for name, values in self.values.items())
    }

  def line(self) -> str:
    """Returns one line for a log: medians and 99th percentiles in milliseconds, then counts."""
    parts = [
      f"{name} {1e3 * row['median']:.1f}/{1e3 * row['p99']:.1f} ms"
      for name, row in sorted(self.summary().items())
    ]
    parts += [f"{name} {number}" for name, number in sorted(self.counts.items())]
    return ", ".join(parts)
