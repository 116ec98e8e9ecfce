"""Convex parts, and what they take of seen free space.

Shapes: X, Y, Z voxels, P points, F faces.
"""

from typing import NamedTuple

import numba
import numpy as np
from scipy import spatial

_ALLOWED = 0.002  # share of a part's voxels that may lie deeper in free space than the tolerance


class Part(NamedTuple):
  """A convex polytope."""

  vertices: np.ndarray  # float64 [P, 3]
  faces: np.ndarray  # int [F, 3], counter-clockwise seen from outside
  planes: np.ndarray  # float64 [F, 4]: n . x + d <= 0 inside
  volume: float


class Space(NamedTuple):
  """How far seen free voxels are from matter."""

  clearance: np.ndarray  # float32 [X, Y, Z]; 0 in matter
  lower: np.ndarray
  voxel: float


def hull(points: np.ndarray, *, max_vertices: int | None = None) -> Part | None:
  """Convex hull of points [P, 3]; None where they are flat.

  With more vertices than allowed, those stay that lie farthest out along evenly spread directions.
  """
  try:
    solid = spatial.ConvexHull(points)
    if max_vertices is not None and len(solid.vertices) > max_vertices:
      corners = points[solid.vertices]
      spread = (corners - corners.mean(0)) / np.maximum(np.ptp(corners, axis=0), 1e-9)
      picked = np.unique((spread @ _directions(2 * max_vertices).T).argmax(0))
      solid = spatial.ConvexHull(corners[picked[:max_vertices]])
  except spatial.QhullError:
    return None
  corners = solid.points[solid.vertices]
  index = np.full(len(solid.points), -1)
  index[solid.vertices] = np.arange(len(solid.vertices))
  faces = index[solid.simplices]
  a, b, c = (corners[faces[:, i]] for i in range(3))
  inward = (np.cross(b - a, c - a) * solid.equations[:, :3]).sum(-1) < 0
  faces[inward] = faces[inward][:, ::-1]
  return Part(corners, faces, solid.equations, float(solid.volume))


def _directions(count: int) -> np.ndarray:
  """Evenly spread unit vectors [count, 3], by the golden angle."""
  i = np.arange(count) + 0.5
  z = 1 - 2 * i / count
  angle = np.pi * (1 + 5**0.5) * i
  level = np.sqrt(1 - z * z)
  return np.stack([level * np.cos(angle), level * np.sin(angle), z], axis=-1)


@numba.njit(cache=True)
def _intrusion(clearance, lower, voxel, first, last, planes, limit):
  """Counts the voxels inside planes, those with more clearance than the limit; sums theirs."""
  inside, bad, deep = 0, 0, 0.0
  for i in range(first[0], last[0]):
    x = lower[0] + voxel * i
    for j in range(first[1], last[1]):
      y = lower[1] + voxel * j
      for k in range(first[2], last[2]):
        z = lower[2] + voxel * k
        within = True
        for f in range(len(planes)):
          if planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z + planes[f, 3] > 0:
            within = False
            break
        if within:
          inside += 1
          if clearance[i, j, k] > limit:
            bad += 1
            deep += clearance[i, j, k]
  return inside, bad, deep


class Intrusion(NamedTuple):
  """What a part takes of seen free space."""

  inside: int  # voxels inside the part
  bad: int  # those of them deeper in free space than the tolerance
  deep: float  # sum of their depths [m]

  @property
  def allowed(self) -> bool:
    return self.bad <= _ALLOWED * self.inside


def intrusion_of(part: Part, space: Space, tolerance: float) -> Intrusion:
  """Counts the seen free cells inside a part, and those that lie too deep in it."""
  shape = np.array(space.clearance.shape)
  first = np.floor((part.vertices.min(0) - space.lower) / space.voxel).astype(int)
  last = np.ceil((part.vertices.max(0) - space.lower) / space.voxel).astype(int) + 1
  first, last = np.clip(first, 0, shape), np.clip(last, 0, shape)
  return Intrusion(
    *_intrusion(space.clearance, space.lower, space.voxel, first, last, part.planes, tolerance)
  )
