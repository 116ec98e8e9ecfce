"""Makes an override file from points that are picked in a finished scene.

Points come in the bundle's world frame. They are written in the frame that the override file
prescribes: the unit frame, but for the extent, which is in the world frame.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nerf2real.core import files
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.alignment import overrides

FLOOR, DISTANCE, ORIGIN, EXTENT = "floor", "distance", "origin", "extent"
PURPOSES: Mapping[str, str] = {
  FLOOR: "three points or more on the floor",
  DISTANCE: "two points, a known distance apart",
  ORIGIN: "one point that becomes x = y = 0",
  EXTENT: "two points or more that the room's extent encloses; its heights stay",
}
_UNIT_FRAME = (FLOOR, DISTANCE, ORIGIN)
_DIGITS = 5  # of coordinates in the file


@dataclasses.dataclass
class Picked:
  """Points picked so far, by purpose, in the world frame [m]."""

  world_from_unit: Similarity
  height: tuple[float, float]
  """Lowest and highest z of the scene's extent [m]."""
  points: dict[str, list[np.ndarray]] = dataclasses.field(
    default_factory=lambda: {purpose: [] for purpose in PURPOSES}
  )

  def values(self, *, distance: float) -> dict[str, Any]:
    """Returns the override file's content, checked.

    Args:
      distance: Of the two points picked for it [m].

    Raises:
      ValueError: Nothing is picked, too few points for a purpose, or an extent beside what moves
        the world frame.
    """
    unit = {name: self._unit(self.points[name]) for name in _UNIT_FRAME if self.points[name]}
    found: dict[str, Any] = {}
    if FLOOR in unit:
      found["floor_points"] = unit[FLOOR]
    if DISTANCE in unit:
      found |= {"scale_points": unit[DISTANCE], "scale_distance": float(distance)}
    if ORIGIN in unit:
      found["origin"] = unit[ORIGIN][-1]
    if self.points[EXTENT]:
      if found:
        raise ValueError(
          f"An extent is in the world frame, which {', '.join(found)} would move: save these, "
          "make the scene again, then pick its extent."
        )
      found |= self._extent()
    if not found:
      raise ValueError("Nothing is picked: expected points for at least one purpose.")
    overrides.from_dict(found, source="picked points")
    return found

  def _unit(self, points: Sequence[np.ndarray]) -> list[list[float]]:
    """Returns points in the unit frame, rounded."""
    mapped = self.world_from_unit.inverse().apply(np.array(points))
    return [[round(float(x), _DIGITS) for x in point] for point in mapped]

  def _extent(self) -> dict[str, Any]:
    """Returns the box around the points picked for it, with the scene's heights."""
    corners = np.array(self.points[EXTENT])[:, :2]
    sides = zip((corners.min(0), corners.max(0)), self.height, strict=True)
    lower, upper = ([round(float(x), _DIGITS) for x in (*side, z)] for side, z in sides)
    return {"extent_lower": lower, "extent_upper": upper}


def save(path: Path, values: Mapping[str, Any]) -> None:
  """Writes an override file (YAML) whole or not at all; other keys of an older one stay.

  Raises:
    ValueError: The older file is wrong, or its keys contradict the new ones.
    OSError: The file cannot be written.
  """
  kept: dict[str, Any] = {}
  if path.exists():
    overrides.read(path)
    kept = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
  merged = kept | dict(values)
  overrides.from_dict(merged, source=str(path))
  path.parent.mkdir(parents=True, exist_ok=True)
  files.write_atomically(path, yaml.safe_dump(merged, sort_keys=False, default_flow_style=None))
