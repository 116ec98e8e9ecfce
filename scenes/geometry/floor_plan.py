"""Projects convex parts to a top-down map of the free floor.

Matter counts between two heights: lower is floor or stepped over, higher passes overhead.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from nerf2real.scenes.geometry import convex, fusion
from nerf2real.scenes.geometry.free_space import FREE, OCCUPIED, UNKNOWN, FreeSpaceMap


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeSpaceSettings:
  """The robot and the map; lengths in metres."""

  resolution: float = 0.01
  """Edge of a cell. A cell that matter touches is blocked whole: cells of 4 cm close a passage that
  is 4 cm wider than the robot."""
  radius: float = 0.18
  """Of the robot: OP3's shoulders are 0.3 m apart, plus its sway."""
  low: float = 0.02
  """Lower matter is stepped over or is floor."""
  high: float = 0.6
  """Matter above passes over the robot's head: OP3 is 0.51 m tall."""
  goals: int = 3
  """Paper, section "Robot navigation": three targets."""
  goal_clearance: float = 0.15
  """More room at a goal than a robot needs to stand."""


def _shadow(part: convex.Part, low: float, high: float) -> np.ndarray | None:
  """Corners [K, 2] of what a convex part covers between two heights; None if it is elsewhere.

  A convex body's slab is convex, so its shadow is the hull of its corners: the part's own within
  the slab and those of its edges with both planes.
  """
  v = part.vertices
  if v[:, 2].max() < low or v[:, 2].min() > high:
    return None
  edges = np.concatenate([part.faces[:, [0, 1]], part.faces[:, [1, 2]], part.faces[:, [2, 0]]])
  found = [v[(v[:, 2] >= low) & (v[:, 2] <= high), :2]]
  for level in (low, high):
    a, b = v[edges[:, 0]], v[edges[:, 1]]
    crosses = (a[:, 2] - level) * (b[:, 2] - level) < 0
    a, b = a[crosses], b[crosses]
    found.append((a + (b - a) * ((level - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None])[:, :2])
  corners = np.concatenate(found)
  return corners if len(corners) else None


def floor_plan(
  parts: Sequence[convex.Part],
  *,
  lower: np.ndarray,
  upper: np.ndarray,
  seen: fusion.Grid | None = None,
  settings: FreeSpaceSettings | None = None,
) -> FreeSpaceMap:
  """Maps the ground inside an extent.

  Args:
    parts: Convex parts, world frame.
    lower: Lower corner of the extent, [>= 2].
    upper: Upper corner of the extent, [>= 2].
    seen: Fused depth, world frame: columns that no ray ever crossed at the robot's height are
      unknown and no place to stand. Without it everything inside the extent counts as seen.
    settings: Settings.
  """
  settings = settings or FreeSpaceSettings()
  origin, size = np.asarray(lower[:2], np.float64), settings.resolution
  width, height = np.maximum(np.ceil((np.asarray(upper[:2]) - origin) / size).astype(int), 1)
  blocked = np.zeros((height, width), np.uint8)
  for part in parts:
    corners = _shadow(part, settings.low, settings.high)
    if corners is not None:
      # Cell (0, 0) has its centre at half a cell; fillConvexPoly takes 1/16 of a cell.
      pixels = np.round(((corners - origin) / size - 0.5) * 16).astype(np.int32)
      cv2.fillConvexPoly(blocked, cv2.convexHull(pixels), 1, shift=4)
  cells = np.where(blocked > 0, OCCUPIED, FREE).astype(np.uint8)
  if seen is not None:
    heights = seen.centres(2)
    band = (heights >= settings.low) & (heights <= settings.high)
    known = (seen.observed & ~seen.solid)[:, :, band].any(-1)
    x = origin[0] + size * (np.arange(width) + 0.5)
    y = origin[1] + size * (np.arange(height) + 0.5)
    i = np.round((x - seen.lower[0]) / seen.voxel).astype(int)
    j = np.round((y - seen.lower[1]) / seen.voxel).astype(int)
    inside = ((i >= 0) & (i < known.shape[0]))[None] & ((j >= 0) & (j < known.shape[1]))[:, None]
    i, j = np.clip(i, 0, known.shape[0] - 1), np.clip(j, 0, known.shape[1] - 1)
    cells[(~(known[i][:, j].T & inside)) & (cells == FREE)] = UNKNOWN
  return FreeSpaceMap(cells=cells, resolution=size, origin=origin, radius=settings.radius)
