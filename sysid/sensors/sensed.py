"""What sensors show beside the joints' motion: one form for IMU, camera and floor."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nerf2real.suite.effects import Effect, kind_of

GAIN = 0.05
"""Nats on held-out seconds that a kind must gain."""
SIGMAS = 3.0
"""Half width of an interval in standard deviations: all of it must be beyond what is usual."""
SOFT = 3.0
"""Noise units beyond which residuals count less."""
STEPS = 6
"""Of Gauss-Newton."""


class Estimate(NamedTuple):
  """A parameter as it was estimated."""

  value: float
  low: float
  high: float
  usual: float = 0.0
  """What sensors of one kind differ by."""


Estimates = Mapping[tuple[str, str], Estimate]
"""By kind of effect and parameter."""


@dataclasses.dataclass
class Part:
  """What one sensor says."""

  rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries of the report for what is named."""
  alternatives: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries for what cannot be told apart."""
  notes: list[str] = dataclasses.field(default_factory=list)
  """Why something was not looked at, a line each."""
  before: float | None = None
  """Error in the sensor's own measure, without the effects."""
  after: float | None = None
  estimates: Estimates = dataclasses.field(default_factory=dict)
  """What was estimated, named or not."""
  in_reference: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  """Entries for what reference logs show, too."""

  @property
  def effects(self) -> list[Effect]:
    """What the model lacks, as effects that can be simulated."""
    return [effect(entry) for entry in (*self.rows, *self.in_reference)]

  def beside(self, reference: "Part") -> "Part":
    """Returns the part with what a reference shows, too, apart from what is named.

    A value has changed where it is off the reference's by more than both intervals, as independent
    errors, and what is usual leave.
    """
    same = [row for row in self.rows if _is_same(row, reference.estimates)]
    changed = [row for row in self.rows if not any(row is s for s in same)]
    return dataclasses.replace(self, rows=changed, in_reference=same)


def _is_same(row: Mapping[str, Any], known: Estimates) -> bool:
  """Tells whether no parameter of an entry differs from what a reference's estimates say."""
  for name, found in row["parameters"].items():
    before = known.get((row["kind"], name))
    if before is None:
      return False
    reach = np.hypot(0.5 * (found["high"] - found["low"]), 0.5 * (before.high - before.low))
    if abs(found["value"] - before.value) > reach + before.usual:
      return False
  return True


def effect(entry: Mapping[str, Any]) -> Effect:
  """Returns an entry of the report as an effect."""
  found = entry["parameters"].items()
  return Effect(
    entry["kind"],
    entry.get("geom") or entry.get("joint"),
    {name: p["value"] for name, p in found},
    {name: (p["low"], p["high"]) for name, p in found},
  )


def row(
  kind: str, sensor: str, values: Mapping[str, tuple[float, float, float]], gain: float, most: float
) -> dict[str, Any]:
  """Returns an effect's entry in the report.

  Args:
    kind: of the effect.
    sensor: that shows it.
    values: value, low and high by parameter.
    gain: nats on held-out seconds.
    most: nats of all hypotheses together.
  """
  return {
    "kind": kind,
    "joint": None,
    "sensor": sensor,
    "parameters": {
      name: {"value": value, "low": low, "high": high, "unit": kind_of(kind).parameter(name).unit}
      for name, (value, low, high) in values.items()
    },
    "evidence": {"gain_nats": round(gain, 4), "gain_of_all_nats": round(most, 4)},
  }
