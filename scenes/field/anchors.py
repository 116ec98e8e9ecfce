"""Depth supervision from localised points: distances along pixels' rays, and empty space.

Source of the first idea: Deng et al. 2022, "Depth-supervised NeRF"; the second is space carving.
Shapes: N pictures, A anchors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.poses.localisation import Localisation, sure_tracks

if TYPE_CHECKING:
  from nerf2real.scenes.field.views import Views

# Chosen, not tuned, for points that may be wrong:
EMPTY_CELLS = 80  # cells along the unit cube: 6 cm in a room of 5 m, finer than furniture
_CROSSINGS = 4  # sight lines that cross an empty cell; fewer may all end at wrong points
_CLEARANCE = 0.4  # no matter this near a camera, as a share of the nearest points' distance
_MARGIN = 0.04  # a sight line ends this far before its point [unit]: 10 cm in a room of 5 m


def known_points(found: Localisation, camera: Camera) -> np.ndarray:
  """Lists the points that the pictures see, each with its distance from the camera.

  Args:
    found: The localised pictures and points.
    camera: The pictures' camera; its pictures may be smaller than the localised ones.

  Returns:
    float32 [A, 4]: index of the picture, pixel x and y, distance along the pixel's ray [unit].
  """
  seen = sure_tracks(found)
  place = seen.pixel * camera.size_ratio(found.camera)
  distance = np.linalg.norm(
    found.points[seen.point] - found.world_from_camera[seen.view, :3, 3], axis=-1
  )
  inside = ((place >= 0) & (place < [camera.width, camera.height])).all(-1)
  rows = np.column_stack([seen.view, np.floor(place), distance])
  return rows[inside].astype(np.float32)


def empty_cells(views: Views) -> np.ndarray:
  """Cells of the unit cube that sight lines from cameras to their points cross.

  Returns:
    Sorted indices int64 [E] into a grid of `EMPTY_CELLS` cells an axis, in order x, y, z.
  """
  anchors = views.anchors
  if not len(anchors):
    return np.zeros(0, np.int64)
  rays = views.camera.rays()
  pictures, x, y = anchors[:, :3].astype(np.int64).T
  rotations = views.world_from_camera[pictures, :3, :3]
  directions = np.einsum("aij,aj->ai", rotations, rays[y, x])
  directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
  origins = views.world_from_camera[pictures, :3, 3]
  step = 2 / EMPTY_CELLS  # every cell that is crossed through its middle is met once
  counts = np.zeros(EMPTY_CELLS**3, np.int64)
  for index in range(int(anchors[:, 3].max() / step) + 1):
    reached = (index + 0.5) * step < anchors[:, 3] - _MARGIN
    points = origins[reached] + (index + 0.5) * step * directions[reached]
    cells = np.floor((points + 1) / step).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < EMPTY_CELLS)).all(-1)]
    flat = (cells[:, 0] * EMPTY_CELLS + cells[:, 1]) * EMPTY_CELLS + cells[:, 2]
    counts += np.bincount(flat, minlength=len(counts))
  crossed = (counts >= _CROSSINGS).reshape((EMPTY_CELLS,) * 3)
  # Lines graze floors and walls: cells beside a point or beside an uncrossed cell do not count.
  ends = np.floor((origins + anchors[:, 3:] * directions + 1) / step).astype(np.int64)
  ends = ends[((ends >= 0) & (ends < EMPTY_CELLS)).all(-1)]
  crossed[tuple(ends.T)] = False
  empty = ndimage.binary_erosion(crossed, np.ones((3, 3, 3)))
  seen = np.ones_like(crossed)
  seen[tuple(ends.T)] = False
  from_points = step * ndimage.distance_transform_edt(seen)
  radius = _CLEARANCE * float(np.percentile(anchors[:, 3], 1))
  axis = (np.arange(EMPTY_CELLS) + 0.5) * step - 1
  for eye in views.world_from_camera[:, :3, 3]:
    window = np.ix_(*[np.flatnonzero(np.abs(axis - center) < radius) for center in eye])
    offset = [axis[line.ravel()] - center for line, center in zip(window, eye, strict=True)]
    from_eye = np.sqrt(sum(np.square(part) for part in np.ix_(*offset)))
    empty[window] |= from_eye < np.minimum(radius, from_points[window])
  return np.flatnonzero(empty)
