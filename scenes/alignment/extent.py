"""Finds the scene's bounding box along the world's axes, and the world's origin: the box's middle,
or where it is from a marker."""

from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.alignment.overrides import Overrides

_CELL = 0.1  # m: surface counts by area, not by pixels
_MIN_POINTS = 100


class Extent(NamedTuple):
  """The world's origin and the box around the room."""

  origin: np.ndarray  # [3] where the world's origin lies, metres along the world's axes
  lower: np.ndarray  # [3] world frame [m]
  upper: np.ndarray  # [3] world frame [m]


def choose_extent(
  evidence: Evidence,
  override: Overrides,
  *,
  metric: Similarity,
  floor_height: float,
  max_height: float,
  outliers: float,
  margin: float,
  camera_margin: float,
  marker_at: MarkerPlace | None = None,
) -> Extent:
  """Finds the box that holds nearly all surface and all cameras, and the origin.

  Args:
    evidence: Points and cameras.
    override: What a person fixed.
    metric: Scale and rotation from the unit frame to the world's axes, without a shift.
    floor_height: The floor's z along these axes [m].
    max_height: Top of the box above the floor [m].
    outliers: Share of surface cells outside the box, on each side.
    margin: Added around the surface [m].
    camera_margin: Room around every camera [m].
    marker_at: Where the marker is to be in the world; None: the origin is the box's middle.

  Raises:
    ValueError: The box is empty.
  """
  down = np.array([0.0, 0.0, floor_height])
  surface, cameras = metric.apply(evidence.densest) - down, metric.apply(evidence.positions) - down
  inside = surface[(surface[:, 2] > -0.1) & (surface[:, 2] < max_height + 0.5)]
  cells = _cells(inside if len(inside) > _MIN_POINTS else surface)
  lower = np.quantile(cells, outliers, axis=0) - margin
  upper = np.quantile(cells, 1 - outliers, axis=0) + margin
  lower = np.minimum(lower, cameras.min(0) - camera_margin)
  upper = np.maximum(upper, cameras.max(0) + camera_margin)
  centre = 0.5 * (lower + upper)
  if override.origin is not None:
    picked = override.origin if len(override.origin) == 3 else np.append(override.origin, 0.0)
    centre = metric.apply(picked)
  elif marker_at is not None and evidence.marker is not None:
    centre = metric.apply(evidence.marker.corners[0].mean(0)) - [marker_at.x, marker_at.y, 0.0]
  shift = np.array([centre[0], centre[1], 0.0])
  lower, upper = lower - shift, upper - shift
  lower[2], upper[2] = 0.0, min(upper[2], max_height)
  if override.extent_lower is not None:
    lower = override.extent_lower
  if override.extent_upper is not None:
    upper = override.extent_upper
  if not (lower < upper).all():
    raise ValueError(
      f"The extent is empty: lower {np.round(lower, 2).tolist()}, upper "
      f"{np.round(upper, 2).tolist()} m. Correct extent_lower and extent_upper in the override "
      "file."
    )
  return Extent(shift + down, lower, upper)


def _cells(points: np.ndarray) -> np.ndarray:
  """Centres of the cubes that hold one or more points [P, 3]."""
  return (np.unique(np.floor(points / _CELL).astype(np.int64), axis=0) + 0.5) * _CELL
