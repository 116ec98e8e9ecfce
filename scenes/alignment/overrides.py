"""The override file: values by hand in place of the alignment's automatic choices.

YAML or JSON. Positions are in the unit frame unless they are said to be in the world frame.
"""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
import yaml


@dataclasses.dataclass(frozen=True, kw_only=True)
class Overrides:
  """Values given by hand; None leaves the choice to the program."""

  floor_points: np.ndarray | None = None
  """[K >= 3, 3] points on the floor, unit frame."""
  up: np.ndarray | None = None
  """[3] up direction, unit frame; the floor is then searched across it."""
  scale: float | None = None
  """Metres per unit."""
  scale_points: np.ndarray | None = None
  """[2, 3] two points, unit frame, with scale_distance."""
  scale_distance: float | None = None
  """Their distance [m]."""
  camera_height: float | None = None
  """Median height of the camera above the floor [m]."""
  yaw_deg: float | None = None
  """The world's x axis against the unit frame's, about up."""
  origin: np.ndarray | None = None
  """[2] or [3] point, unit frame, that becomes x = y = 0."""
  extent_lower: np.ndarray | None = None
  """[3] world frame [m]."""
  extent_upper: np.ndarray | None = None
  """[3] world frame [m]."""
  floor_threshold: float | None = None
  """Matter below this height counts as floor [m]."""


_SHAPES = {
  "floor_points": "a list of at least three points [x, y, z]",
  "up": "a direction [x, y, z]",
  "scale": "a positive number (metres per unit)",
  "scale_points": "two points [[x, y, z], [x, y, z]]",
  "scale_distance": "a positive number (m)",
  "camera_height": "a positive number (m)",
  "yaw_deg": "a number (degrees)",
  "origin": "a point [x, y] or [x, y, z]",
  "extent_lower": "a corner [x, y, z] (m)",
  "extent_upper": "a corner [x, y, z] (m)",
  "floor_threshold": "a positive number (m)",
}


def _valid(name: str, value: Any) -> np.ndarray | float | None:
  """Returns the value as a number or array, or None where it does not fit the field."""
  try:
    array = np.asarray(value, np.float64)
  except (TypeError, ValueError):
    return None
  if isinstance(value, bool) or not np.isfinite(array).all():
    return None
  if name in ("scale", "scale_distance", "camera_height", "floor_threshold"):
    return float(array) if array.ndim == 0 and array > 0 else None
  if name == "yaw_deg":
    return float(array) if array.ndim == 0 else None
  if name == "floor_points":
    return array if array.ndim == 2 and array.shape[0] >= 3 and array.shape[1] == 3 else None
  if name == "scale_points":
    return array if array.shape == (2, 3) and np.ptp(array, axis=0).any() else None
  if name == "origin":
    return array if array.shape in ((2,), (3,)) else None
  if name == "up" and not array.any():
    return None
  return array if array.shape == (3,) else None


def from_dict(values: Any, *, source: str = "overrides") -> Overrides:
  """Checks a mapping of overrides.

  Raises:
    ValueError: one line that names the source, the key, what was found and what is expected.
  """
  if values is None:
    return Overrides()
  if not isinstance(values, dict):
    raise ValueError(f"{source}: expected keys with values, found {type(values).__name__}.")
  result: dict[str, Any] = {}
  for name, value in values.items():
    if name not in _SHAPES:
      raise ValueError(f'{source}: unknown key "{name}"; known: {", ".join(_SHAPES)}.')
    if value is None:
      continue
    checked = _valid(name, value)
    if checked is None:
      raise ValueError(f"{source}: {name} must be {_SHAPES[name]}, found {value!r}.")
    result[name] = checked
  if ("scale_points" in result) != ("scale_distance" in result):
    raise ValueError(f"{source}: scale_points and scale_distance must be given together.")
  scales = [n for n in ("scale", "scale_points", "camera_height") if n in result]
  if len(scales) > 1:
    raise ValueError(f"{source}: {' and '.join(scales)} both fix the scale; give one of them.")
  points = result.get("floor_points")
  if points is not None and np.linalg.svd(points - points.mean(0))[1][1] < 1e-9:
    raise ValueError(f"{source}: floor_points lie on one line; give three that span the floor.")
  low, high = result.get("extent_lower"), result.get("extent_upper")
  if low is not None and high is not None and not (low < high).all():
    raise ValueError(
      f"{source}: extent_lower {low.tolist()} must be below extent_upper {high.tolist()}."
    )
  return Overrides(**result)


def read(path: pathlib.Path) -> Overrides:
  """Reads an override file, YAML or JSON.

  Raises:
    ValueError: it is wrong; one line with the fault.
  """
  if not path.is_file():
    what = "is a folder, expected a file" if path.is_dir() else "does not exist"
    raise ValueError(f"The override file {path} {what}.")
  try:
    text = path.read_text(encoding="utf-8")
    values = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
  except (UnicodeDecodeError, json.JSONDecodeError, yaml.YAMLError) as error:
    reason = " ".join(str(error).split())
    raise ValueError(f"{path} is no valid {path.suffix[1:] or 'YAML'}: {reason}") from error
  return from_dict(values, source=str(path))
