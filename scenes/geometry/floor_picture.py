"""Draws a scene's free space from above."""

import numpy as np

from nerf2real.core.floor_map import Extent, Floor, FloorMap
from nerf2real.scenes.geometry.free_space import OCCUPIED, UNKNOWN, FreeSpace, FreeSpaceMap

_CELL = 0.04  # m; where a free space has no cells of its own


def draw(
  space: FreeSpace, extent: tuple[np.ndarray, np.ndarray], *, height: int, margin: float = 0.0
) -> FloorMap:
  """Draws the reachable floor, and matter and unseen places where the space holds them.

  Args:
    space: The free space.
    extent: Lower and upper corner [>= 2] of the area [m].
    height: Height of the picture [pixel].
    margin: Added to the area on all sides [m].
  """
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
  if isinstance(space, FreeSpaceMap):
    floor = Floor(
      reachable=space.reachable,
      resolution=space.resolution,
      origin=space.origin,
      occupied=space.cells == OCCUPIED,
      unknown=space.cells == UNKNOWN,
    )
  else:
    grid = space.grid((lower, upper), _CELL)
    floor = Floor(reachable=grid.free.T, resolution=grid.cell, origin=grid.lower)
  (x_from, y_from), (x_to, y_to) = lower - margin, upper + margin
  area: Extent = (float(x_from), float(x_to), float(y_from), float(y_to))
  return FloorMap.of(floor, height=height, extent=area)
