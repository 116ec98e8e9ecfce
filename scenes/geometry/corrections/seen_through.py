"""Puts plain pixels that see through a surface of other views onto that surface.

A wall that several views have found flat is there for every view. Where one of them has depth
behind it and its picture is plain, so that nothing says where that depth comes from, it is the
wall's. Textured pixels keep their depth: they would show that the wall is not there.
Shapes: N views, H height, W width, P points.
"""

import dataclasses

import numba
import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.geometry.corrections.plain_surfaces import (
  FARTHEST,
  clearly,
  colors,
  is_plain,
)

_CELL = 0.04  # m, edge of the cells in which views agree on a surface
_VIEWS = 3  # that have found it flat, chosen
_NEAREST = 0.2  # m from a camera; what is nearer hides nothing here


def closed(
  views: fusion.DepthViews, flat: np.ndarray, *, progress: Progress = no_progress
) -> fusion.DepthViews:
  """Returns depth pictures in which no plain pixel sees through what other views have found flat.

  Args:
    views: Depth pictures with colours in the world frame (metres).
    flat: Pixels that were put onto planes, bool [N, H, W].
    progress: Called with the fraction done and a text.

  Raises:
    ValueError: Where the views have no colours.
  """
  pictures = colors(views)
  points = _agreed(views, flat)
  widest = np.abs(views.camera.rays()[..., :2]).max((0, 1))
  depth = views.depth.copy()
  for index, pose in enumerate(views.frame_from_camera):
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    # Lenses are known within the picture alone.
    shown = local[:, 2] > _NEAREST
    shown &= (np.abs(local[:, :2]) <= widest * local[:, 2:]).all(-1)
    local = local[shown]
    pixels = np.floor(views.camera.project(local)).astype(np.int64)
    half = np.ceil(0.6 * _CELL * views.camera.fx / local[:, 2]).astype(np.int64)
    surface = _drawn(depth.shape[1:], pixels, local[:, 2], half, 0.5 * _behind(local[:, 2]))
    moved = is_plain(pictures[index]) & (depth[index] < surface + FARTHEST)
    moved &= depth[index] > surface + _behind(surface)
    depth[index][moved] = surface[moved]
    progress((index + 1) / len(depth), "plain surfaces that other views have")
  return dataclasses.replace(views, depth=depth)


def _behind(depth: np.ndarray) -> np.ndarray:
  """How far behind a surface of a depth [...] is behind it: a cell more than is clear [m]."""
  return _CELL + clearly(depth)


def _agreed(views: fusion.DepthViews, flat: np.ndarray) -> np.ndarray:
  """Points [P, 3], one a cell, of surfaces that enough views have found flat."""
  rays = views.camera.rays()
  points = []
  for pose, depth, own in zip(views.frame_from_camera, views.depth, flat, strict=True):
    lifted = rays[own] * depth[own, None] @ pose[:3, :3].T + pose[:3, 3]
    _, first = np.unique(_cells(lifted), axis=0, return_index=True)
    points.append(lifted[first])
  every = np.concatenate(points)
  _, which, count = np.unique(_cells(every), axis=0, return_inverse=True, return_counts=True)
  sums = np.stack([np.bincount(which.ravel(), every[:, k], len(count)) for k in range(3)], -1)
  mean: np.ndarray = (sums / count[:, None])[count >= _VIEWS]
  return mean


def _cells(points: np.ndarray) -> np.ndarray:
  return np.floor(points / _CELL).astype(np.int32)


@numba.njit(cache=True)
def _drawn(shape, pixels, depth, half, slack):
  """Depth [H, W] of squares of half widths [P] about pixels [P, 2] (x, y), the nearest ones; inf
  where there is none, along the rim, which squares widen, and where they show a surface from so
  far aside that its depth changes by more than the slack [P] within one."""
  height, width = shape
  surface = np.full((height, width), np.inf, np.float32)
  drawn = np.zeros((height, width), np.int64)
  for n in range(len(pixels)):
    x, y, r = pixels[n, 0], pixels[n, 1], half[n]
    for i in range(max(y - r, 0), min(y + r + 1, height)):
      for j in range(max(x - r, 0), min(x + r + 1, width)):
        if depth[n] < surface[i, j]:
          surface[i, j], drawn[i, j] = depth[n], n
  inner = np.full((height, width), np.inf, np.float32)
  for i in range(height):
    for j in range(width):
      own = surface[i, j]
      if own == np.inf:
        continue
      r, limit = half[drawn[i, j]], slack[drawn[i, j]]
      above, below = surface[max(i - r, 0), j], surface[min(i + r, height - 1), j]
      left, right = surface[i, max(j - r, 0)], surface[i, min(j + r, width - 1)]
      if max(abs(above - own), abs(below - own), abs(left - own), abs(right - own)) < limit:
        inner[i, j] = own
  return inner
