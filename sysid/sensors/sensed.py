"""What sensors show beside the joints' motion: one form for IMU, camera and floor."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from nerf2real.suite.effects import Effect, kind_of


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

  @property
  def effects(self) -> list[Effect]:
    """What is named, as effects that can be simulated."""
    return [effect(entry) for entry in self.rows]


def effect(entry: Mapping[str, Any]) -> Effect:
  """Returns an entry of the report as an effect."""
  found = entry["parameters"].items()
  return Effect(
    entry["kind"],
    entry.get("geom"),
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
