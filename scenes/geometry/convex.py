"""Convex parts, and what they take of seen free space.

Shapes: X, Y, Z voxels, P points, F faces.
"""

import functools
from typing import NamedTuple

import numba
import numpy as np
from scipy import spatial

_ALLOWED = 0.002  # share of a part's volume that may lie deeper in free space than the tolerance
_SPACING = 0.01  # m between places that are looked at; 0.4 of the tolerance of the parts


class Part(NamedTuple):
  """A convex polytope."""

  vertices: np.ndarray  # float64 [P, 3]
  faces: np.ndarray  # int [F, 3], counter-clockwise seen from outside
  planes: np.ndarray  # float64 [F, 4]: n . x + d <= 0 inside
  volume: float


class Space(NamedTuple):
  """How far seen free space is from matter."""

  clearance: np.ndarray  # float32 [X, Y, Z] of the voxels' centres [m]; negative in matter
  lower: np.ndarray  # centre of the first voxel [3]
  voxel: float  # edge [m]


def hull(points: np.ndarray, *, max_vertices: int | None = None) -> Part | None:
  """Convex hull of points [P, 3]; None where they are flat.

  With more vertices than allowed, those stay that lie farthest out along evenly spread directions.
  """
  try:
    solid = spatial.ConvexHull(points)
    if max_vertices is not None and len(solid.vertices) > max_vertices:
      corners = points[solid.vertices]
      solid = spatial.ConvexHull(corners[_farthest(corners, max_vertices)])
  except spatial.QhullError:
    return None
  corners = solid.points[solid.vertices]
  index = np.full(len(solid.points), -1)
  index[solid.vertices] = np.arange(len(solid.vertices))
  faces = index[solid.simplices]
  _face_outwards(faces, corners, solid.equations)
  return Part(corners, faces, solid.equations, float(solid.volume))


@numba.njit(cache=True)
def _face_outwards(faces, corners, planes):
  """Turns the faces [F, 3] that are clockwise seen from outside of their planes [F, 4]."""
  for f in range(len(faces)):
    a, b, c = corners[faces[f, 0]], corners[faces[f, 1]], corners[faces[f, 2]]
    along = 0.0
    for i in range(3):
      j, k = (i + 1) % 3, (i + 2) % 3
      along += ((b[j] - a[j]) * (c[k] - a[k]) - (b[k] - a[k]) * (c[j] - a[j])) * planes[f, i]
    if along < 0:
      faces[f, 0], faces[f, 2] = faces[f, 2], faces[f, 0]


def _farthest(corners: np.ndarray, count: int) -> np.ndarray:
  """Indices of at most `count` corners [P, 3] that lie farthest out along spread directions.

  They come from as many directions first, which leave no side out, and then from twice as many.
  """
  spread = (corners - corners.mean(0)) / np.maximum(np.ptp(corners, axis=0), 1e-9)
  taken = np.zeros(len(corners), bool)
  taken[(spread @ _directions(count).T).argmax(0)] = True
  more = taken.copy()
  more[(spread @ _directions(2 * count).T).argmax(0)] = True
  first = np.flatnonzero(taken)
  return np.append(first, np.flatnonzero(more & ~taken)[: count - len(first)])


@functools.cache
def _directions(count: int) -> np.ndarray:
  """Evenly spread unit vectors [count, 3], by the golden angle."""
  i = np.arange(count) + 0.5
  z = 1 - 2 * i / count
  angle = np.pi * (1 + 5**0.5) * i
  level = np.sqrt(1 - z * z)
  return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=-1)


@numba.njit(cache=True)
def _corners(clearance, i, j, k):
  """Least, greatest and mean clearance at the corners of the cell behind a voxel's centre."""
  low, high, total = np.inf, -np.inf, 0.0
  for corner in range(8):
    value = clearance[i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)]
    low, high, total = min(low, value), max(high, value), total + value
  return low, high, total / 8


@numba.njit(cache=True)
def _between(clearance, i, j, k, u, v, w):
  """Clearance at a place in that cell, shares u, v, w of its edges from the voxel's centre."""
  found = 0.0
  for corner in range(8):
    a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
    weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
    found += weight * clearance[i + a, j + b, k + c]
  return found


@numba.njit(cache=True)
def _height(planes, x, y, z, enough):
  """Greatest height of a place over the planes, or one that is more than enough."""
  found = -np.inf
  for f in range(len(planes)):
    height = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z + planes[f, 3]
    found = max(found, height)
    if found > enough:
      break
  return found


@numba.njit(cache=True)
def _intrusion(clearance, lower, voxel, first, last, planes, limit, along):
  """Counts places inside planes with more clearance than the limit, and sums their clearance.

  Cells of the grid that lie wholly inside and too deep are counted at once.
  """
  bad, deep = 0, 0.0
  radius = 0.5 * np.sqrt(3.0) * voxel  # of a cell
  for i in range(first[0], last[0]):
    for j in range(first[1], last[1]):
      for k in range(first[2], last[2]):
        low, high, mean = _corners(clearance, i, j, k)
        if high <= limit:
          continue
        x, y, z = lower[0] + voxel * i, lower[1] + voxel * j, lower[2] + voxel * k
        half = 0.5 * voxel
        middle = _height(planes, x + half, y + half, z + half, radius)
        if middle > radius:
          continue
        whole = middle <= -radius
        if whole and low > limit:
          bad += along**3
          deep += along**3 * mean
          continue
        for n in range(along**3):
          u = (n % along + 0.5) / along
          v = (n // along % along + 0.5) / along
          w = (n // along**2 + 0.5) / along
          free = _between(clearance, i, j, k, u, v, w)
          if free > limit and (
            whole or _height(planes, x + u * voxel, y + v * voxel, z + w * voxel, 0.0) <= 0
          ):
            bad += 1
            deep += free
  return bad, deep


class Intrusion(NamedTuple):
  """What a part takes of seen free space."""

  volume: float  # of the part [m^3]
  bad: float  # of it deeper in free space than the tolerance [m^3]
  deep: float  # integral of the clearance over that [m^4]

  @property
  def allowed(self) -> bool:
    return self.bad <= _ALLOWED * self.volume


def intrusion_of(part: Part, space: Space, tolerance: float) -> Intrusion:
  """Measures how much of a part lies too deep in seen free space.

  The clearance is taken between the voxels' centres, too, at places at most `_SPACING` apart: what
  is found depends on where the surface is and not on where the voxels are.

  Args:
    part: The part.
    space: Clearance around it; outside of its voxels' centres nothing counts.
    tolerance: So deep a part may reach [m].
  """
  shape = np.array(space.clearance.shape) - 1
  first = np.floor((part.vertices.min(0) - space.lower) / space.voxel).astype(int)
  last = np.ceil((part.vertices.max(0) - space.lower) / space.voxel).astype(int)
  first, last = np.clip(first, 0, shape), np.clip(last, 0, shape)
  along = int(np.ceil(space.voxel / _SPACING))
  bad, deep = _intrusion(
    space.clearance, space.lower, space.voxel, first, last, part.planes, tolerance, along
  )
  cell = (space.voxel / along) ** 3
  return Intrusion(part.volume, cell * bad, cell * deep)
