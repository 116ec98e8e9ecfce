"""Where samples lie on a ray, in numba: empty-space skipping through two occupancy grids.

The inner grid covers the unit cube; the outer one the whole squashed space of `contraction`. Inside
the cube samples are `step` apart, outside `OUTER_STEP * step * |x|_max`.
"""

from typing import NamedTuple

import numba
import numpy as np

_ZERO, _ONE, _HALF, _TWO, _QUARTER = (np.float32(x) for x in (0, 1, 0.5, 2, 0.25))
FAR = np.float32(16.0)  # ours: rays end here [unit]; squashed to 1.94 of 2
OUTER_STEP = np.float32(2.0)  # ours: outside, intervals are this many steps times |x|_max


class Occupancy(NamedTuple):
  """Where matter may be. Cells are ordered x, y, z with z fastest."""

  inner_size: int  # cells along an axis of the unit cube
  inner_distance: np.ndarray  # uint8: cells to the nearest occupied one (Chebyshev), 0 = occupied
  inner_density: np.ndarray  # float32: recent maximum of the density [1/unit]
  outer_size: int  # cells along an axis of the squashed space [-2, 2]^3
  outer_distance: np.ndarray  # uint8: likewise, in squashed cells
  outer_density: np.ndarray  # float32


@numba.njit(nogil=True, error_model="numpy", inline="always")
def uniform(seed, index, dimension):
  """A number in [0, 1) that depends on nothing but its arguments (splitmix64)."""
  z = (
    np.uint64(seed)
    + np.uint64(index) * np.uint64(0x9E3779B97F4A7C15)
    + np.uint64(dimension) * np.uint64(0xD1B54A32D192ED03)
  )
  z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
  z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
  z = z ^ (z >> np.uint64(31))
  return np.float32(z >> np.uint64(40)) * np.float32(1 / 16777216)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")
def squash(x, y, z, norm):
  """Grid coordinates in [0, 1]^3 of a point whose max(1, |x|_max) is `norm`."""
  factor = (_TWO - _ONE / norm) / norm * _QUARTER
  top = np.float32(0.9999999)
  return (
    min(max(x * factor + _HALF, _ZERO), top),
    min(max(y * factor + _HALF, _ZERO), top),
    min(max(z * factor + _HALF, _ZERO), top),
  )


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def march(
  occupancy, ox, oy, oz, dx, dy, dz, near, jitter, step, depth_limit, limit, distances, lengths, at
):
  """Writes the middles and lengths of a ray's intervals that lie in occupied cells.

  Args:
    occupancy: The grids.
    ox, oy, oz, dx, dy, dz: Origin and unit direction.
    near: Distance where the ray starts.
    jitter: Fraction of a step by which the intervals are shifted.
    step: Interval length inside the unit cube.
    depth_limit: The ray ends where the grids' optical depth passes this.
    limit: Most samples of a ray.
    distances, lengths: Results, written from index `at`.

  Returns:
    Number of samples.
  """
  count = 0
  t = near + jitter * step
  size = occupancy.inner_size
  half_size = np.float32(size) * _HALF
  cell = _ONE / half_size
  outer_size = occupancy.outer_size
  outer_scale = np.float32(outer_size)
  outer_cell = _TWO / outer_scale
  steepest = max(abs(dx), max(abs(dy), abs(dz)))
  depth = _ZERO
  stride_per_cell = cell / (steepest * step)
  while t < FAR and count < limit:
    middle = t + _HALF * step
    x, y, z = ox + middle * dx, oy + middle * dy, oz + middle * dz
    norm = max(abs(x), max(abs(y), abs(z)))
    if norm < _ONE:
      index = (
        np.int64((x + _ONE) * half_size) * size + np.int64((y + _ONE) * half_size)
      ) * size + np.int64((z + _ONE) * half_size)
      away = occupancy.inner_distance[index]
      if away == 0:
        distances[at + count] = middle
        lengths[at + count] = step
        count += 1
        depth += occupancy.inner_density[index] * step
        if depth > depth_limit:
          break
        t += step
      else:
        whole = np.int64(np.float32(away - 1) * stride_per_cell)
        t += step * np.float32(max(whole, 1))
    else:
      length = OUTER_STEP * step * norm
      middle = t + _HALF * length
      x, y, z = ox + middle * dx, oy + middle * dy, oz + middle * dz
      norm = max(_ONE, max(abs(x), max(abs(y), abs(z))))
      u, v, w = squash(x, y, z, norm)
      index = (
        np.int64(u * outer_scale) * outer_size + np.int64(v * outer_scale)
      ) * outer_size + np.int64(w * outer_scale)
      away = occupancy.outer_distance[index]
      if away == 0:
        distances[at + count] = middle
        lengths[at + count] = length
        count += 1
        depth += occupancy.outer_density[index] * length
        if depth > depth_limit:
          break
        t += length
      else:
        # Squashing shrinks lengths by norm / 2 at least.
        t += max(np.float32(away - 1) * outer_cell * norm, length)
  return count


def chebyshev_distance(occupied: np.ndarray, *, limit: int) -> np.ndarray:
  """Distance of every cell to the nearest occupied one, in cells.

  Dilates by one cell along each axis in turn, which is exact for the maximum norm.

  Args:
    occupied: bool [R, R, R].
    limit: Largest distance to tell apart.

  Returns:
    Distances uint8 [R, R, R], 0 where occupied, at most `limit`.
  """
  near = occupied.copy()
  distance = np.full(occupied.shape, limit, np.uint8)
  for ring in range(limit):
    if ring > 0:
      for axis in range(3):
        line = np.moveaxis(near, axis, 0)
        before = line.copy()
        line[1:] |= before[:-1]
        line[:-1] |= before[1:]
    distance -= near.view(np.uint8)
  return distance
