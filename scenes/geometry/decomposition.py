"""Decomposes the solid voxels of a grid into convex parts that leave seen free space free.

MuJoCo collides convex hulls only, and the hull of a room is a filled block. So the solid is cut
into cells first; a cell whose hull covers no seen free space is a part as it is, the others are
cut on by planes along the axes; then neighbours are merged for as long as their common hull still
keeps out of free space. Space that no ray reached counts as solid behind seen matter, unless it
borders on seen free space, as under a table: so furniture and walls have an inside.

In place of the cuts, CoACD (Wei et al. 2022), which does not use what was seen, gave 119 parts
of a room of boxes instead of 111, 95 % within 2.0 and 2.5 cm of the truth, both ways, not 2.8
and 3.1 cm, and took 228 s instead of 25 s on the same busy machine.
Shapes: X, Y, Z voxels, P points, F faces.
"""

import dataclasses
from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import fusion, merging, surface_distance
from nerf2real.scenes.geometry.convex import Part, Space, hull, intrusion_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConvexSettings:
  """Settings of the convex decomposition; lengths in metres."""

  cell: float = 1.0
  """The solid is cut into cubes of this size before anything else."""
  tolerance: float = 0.01
  """A part may reach this far into seen free space: a cell of the floor's map. 0.025 takes four
  tenths of the time, leaves 2 % less floor and reaches 2 mm farther into free space on average."""
  doubt: float = 0.3
  """Unseen space this near to seen free space counts as free too."""
  inside: float = 0.08
  """Other unseen space counts as matter this near to seen matter: as thick again as the fused band,
  so that a gap narrower than two bands closes. With less a ball of 10 cm finds room inside of
  furniture, with more the parts lie farther from what was seen."""
  max_parts: int = 1000
  """Parts are merged until they are this few, those first that reach least into free space."""
  max_vertices: int = 48
  """Of a part; MuJoCo's contact cost grows with it."""
  min_volume: float = 2e-5
  """Smaller parts are dropped [m^3]: a cube of 2.7 cm."""


class _Matter(NamedTuple):
  """Solid voxels and where the surface crosses the grid's edges beside them."""

  solid: np.ndarray  # bool [X, Y, Z]
  values: np.ndarray  # float32 [X, Y, Z], negative where solid
  space: Space


@numba.njit(cache=True)
def _outer_ends(columns, values, start, side):
  """Outer ends of columns [A, B, L] at the surface's crossings, in voxels of the values' array.

  Of the columns of a slice only those whose ends are corners of the slice's hull are returned.

  Args:
    columns: Voxels of a piece, bool [A, B, L].
    values: Of the whole grid [A', B', L'], negative in matter.
    start: Index of the first column's first voxel there [3].
    side: -1 for the columns' first ends, 1 for their last.

  Returns:
    Places [P, 3] along the three axes.
  """
  first, second, length = columns.shape
  found = np.empty((first * second, 3))
  count = 0
  places, heights = np.empty(second, np.int64), np.empty(second)
  for a in range(first):
    size = 0  # of the stack of corners
    for b in range(second):
      end = -1
      for n in range(length):
        at = n if side < 0 else length - 1 - n
        if columns[a, b, at]:
          end = at
          break
      if end < 0:
        continue
      i, j, k = start[0] + a, start[1] + b, start[2] + end
      here, there = values[i, j, k], values[i, j, min(max(k + side, 0), values.shape[2] - 1)]
      # Towards free space the surface lies between both; at a cut half a voxel closes the gap.
      share = min(max(here / min(here - there, -1e-6), 0.0), 1.0) if there > 0 else 0.5
      height = side * k + share
      while size >= 2:
        p, q = places[size - 2], places[size - 1]
        rise = (heights[size - 1] - heights[size - 2]) * (b - p)
        if rise > (height - heights[size - 2]) * (q - p):
          break
        size -= 1
      places[size], heights[size] = b, height
      size += 1
    for n in range(size):
      found[count, 0] = start[0] + a
      found[count, 1] = start[1] + places[n]
      found[count, 2] = side * heights[n]
      count += 1
  return found[:count]


_TURNS = ((1, 2, 0), (2, 0, 1), (0, 1, 2))  # axes of the grid, so that each of them is last once


def _piece_points(piece: np.ndarray, start: np.ndarray, matter: _Matter) -> np.ndarray:
  """Points [P, 3] whose hull is the piece's: outer ends of its columns at the surface's crossings.

  Args:
    piece: Solid voxels of the piece bool [x, y, z], a block of the grid.
    start: Index of the block's first voxel [3].
    matter: The whole solid.
  """
  found = []
  for turn in _TURNS:
    columns, values = piece.transpose(turn), matter.values.transpose(turn)
    for side in (-1, 1):
      ends = _outer_ends(columns, values, start[list(turn)], side)
      found.append(ends[:, np.argsort(turn)])
  return matter.space.lower + matter.space.voxel * np.concatenate(found)


def _cuts(piece: np.ndarray, count: int) -> list[tuple[int, int]]:
  """Candidate cuts of a piece: the middle of each axis and the jumps of its profile."""
  result = []
  for axis in range(3):
    length = piece.shape[axis]
    if length < 2:
      continue
    profile = piece.sum(axis=tuple(a for a in range(3) if a != axis)).astype(float)
    jumps = np.abs(np.diff(profile))
    chosen = {length // 2}
    for _ in range(count):
      best = int(jumps.argmax())
      if jumps[best] <= 0:
        break
      chosen.add(best + 1)
      jumps[max(0, best - 2) : best + 3] = 0
    result += [(axis, cut) for cut in sorted(chosen)]
  return result


def _trim(piece: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Drops empty borders of a block."""
  lows, highs = [], []
  for axis in range(3):
    used = np.flatnonzero(piece.any(axis=tuple(a for a in range(3) if a != axis)))
    lows.append(used[0])
    highs.append(used[-1] + 1)
  block = tuple(slice(a, b) for a, b in zip(lows, highs, strict=True))
  return piece[block], start + np.array(lows)


def _halves(piece, start, axis, cut, matter, settings):
  """Cuts a piece; each half as (voxels, start, hull, what it takes of free space)."""
  result = []
  for side in (slice(None, cut), slice(cut, None)):
    index = [slice(None)] * 3
    index[axis] = side
    half = piece[tuple(index)]
    if not half.any():
      continue
    offset = start.copy()
    offset[axis] += side.start or 0
    half, offset = _trim(half, offset)
    part = hull(_piece_points(half, offset, matter), max_vertices=settings.max_vertices)
    if part is not None:
      bad = intrusion_of(part, matter.space, settings.tolerance)
      result.append((half, offset, part, bad))
  return result


def _split(piece, start, part, matter: _Matter, settings: ConvexSettings) -> list[Part]:
  """Cuts a piece by axis-aligned planes, each time the best one, until every hull keeps out."""
  if intrusion_of(part, matter.space, settings.tolerance).allowed or max(piece.shape) < 2:
    return [part]
  best, score = [], np.inf
  for axis, cut in _cuts(piece, 2):
    halves = _halves(piece, start, axis, cut, matter, settings)
    # What is too deep first, then volume: an equal cut that leaves smaller hulls follows the
    # shape better.
    total = sum(h[3].bad + 0.02 * h[3].volume for h in halves)
    if halves and total < score:
      best, score = halves, total
  parts = []
  for half, offset, smaller, _ in best:
    if smaller.volume >= settings.min_volume:
      parts += _split(half, offset, smaller, matter, settings)
  return parts


def decompose(
  grid: fusion.Grid,
  *,
  settings: ConvexSettings | None = None,
  progress: Progress = no_progress,
) -> list[Part]:
  """Decomposes the solid of a grid.

  Raises:
    ValueError: the grid holds no matter.
  """
  settings = settings or ConvexSettings()
  if not grid.solid.any():
    raise ValueError(
      "Found no matter above the floor inside the extent: nothing to collide with. Check extent, "
      "scale and floor_threshold in the override file."
    )
  reach = max(1, round(settings.doubt / grid.voxel))
  free = ndimage.binary_dilation(grid.observed & ~grid.solid, iterations=reach, mask=~grid.solid)
  values = np.where(free | grid.solid, grid.values, np.float32(-1))
  clearance = surface_distance.signed_distance(values, grid.voxel)
  space = Space(clearance, np.asarray(grid.lower, np.float64), grid.voxel)
  depth = ndimage.distance_transform_edt(~grid.solid) * grid.voxel
  solid = ~free & (depth <= settings.inside)
  matter = _Matter(solid, values, space)
  parts: list[Part] = []
  step = max(4, round(settings.cell / grid.voxel))
  starts = np.stack(
    np.meshgrid(*[np.arange(0, n, step) for n in free.shape], indexing="ij"), -1
  ).reshape(-1, 3)
  for number, corner in enumerate(starts):
    block = tuple(slice(a, a + step) for a in corner)
    labels, count = ndimage.label(matter.solid[block], structure=np.ones((3, 3, 3)))
    for label in range(1, count + 1):
      piece, start = _trim(labels == label, corner)
      whole = hull(_piece_points(piece, start, matter), max_vertices=settings.max_vertices)
      if whole is None or whole.volume < settings.min_volume:
        continue
      if intrusion_of(whole, space, settings.tolerance).allowed:
        parts.append(whole)
      else:
        parts += _split(piece, start, whole, matter, settings)
    progress(0.8 * (number + 1) / len(starts), "convex parts")
  parts = merging.merge(
    parts,
    space,
    tolerance=settings.tolerance,
    max_parts=settings.max_parts,
    max_vertices=settings.max_vertices,
  )
  progress(1.0, f"{len(parts)} convex parts")
  return parts
