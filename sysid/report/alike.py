"""Entries that say the same of many joints, as one entry for the reader."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.sysid.settings import SETTINGS

_SEVERAL = 3  # joints from which one entry stands for all, chosen


def place(effect: dict[str, Any], everywhere: str = "all") -> str:
  """Returns where an entry's effect is, in a word."""
  places = (effect.get(noun) for noun in ("joint", "body", "geom", "sensor"))
  return next((place for place in places if place), everywhere)


def together(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
  """Returns entries with one for all gains of servos' laws that are alike, in place of the first.

  Alike are gains that differ from their median by no more than a data sheet leaves open. The one
  entry has the median, from the lowest end of the joints' intervals to the highest; report.json
  keeps the joints' own.

  Args:
    entries: of a report; they stay.
  """
  own = [e for e in entries if e.get("evidence", {}).get("servo_law")]
  if not own:
    return list(entries)
  middle = float(np.median([e["parameters"]["gain"]["value"] for e in own]))
  reach = SETTINGS.duty_scale * middle
  alike = [e for e in own if abs(e["parameters"]["gain"]["value"] - middle) <= reach]
  if len(alike) < _SEVERAL:
    return list(entries)
  gains = [e["parameters"]["gain"] for e in alike]
  least = min(e["evidence"]["clear_by_standard_errors"] for e in alike)
  one = {
    **alike[0],
    "joint": f"{len(alike)} joints",
    "parameters": {
      "gain": {
        "value": float(np.median([g["value"] for g in gains])),
        "low": min(g["low"] for g in gains),
        "high": max(g["high"] for g in gains),
        "unit": gains[0]["unit"],
      }
    },
    "evidence": {**alike[0]["evidence"], "clear_by_standard_errors": least},
  }
  at = next(i for i, e in enumerate(entries) if e is alike[0])
  kept = [(i, e) for i, e in enumerate(entries) if not any(e is a for a in alike)]
  return [*(e for i, e in kept if i < at), one, *(e for i, e in kept if i > at)]
