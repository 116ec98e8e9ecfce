"""The hash grid in numba: interpolation, its gradient and the optimiser's step on the table.

The table is flat float32 [L * T * 2]: row (level * T + index) holds two features. Shapes: N points.
"""

import numba
import numpy as np

from nerf2real.scenes.field.fused.cache import KERNEL_CACHE

_PRIME_Y = np.uint32(2654435761)
_PRIME_Z = np.uint32(805459861)
_ONE = np.float32(1)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")
def _corner_rows(ix, iy, iz, resolution, entries):
  """Rows of the 8 corners of a cell: x varies fastest."""
  side = resolution + 1
  if side * side * side <= entries:
    first = ix + side * (iy + side * iz)
    plane = first + side * side
    return (
      first,
      first + 1,
      first + side,
      first + side + 1,
      plane,
      plane + 1,
      plane + side,
      plane + side + 1,
    )
  mask = np.uint32(entries - 1)
  x0 = np.uint32(ix)
  x1 = np.uint32(ix + 1)
  y0 = np.uint32(np.uint32(iy) * _PRIME_Y)
  y1 = np.uint32(y0 + _PRIME_Y)
  z0 = np.uint32(np.uint32(iz) * _PRIME_Z)
  z1 = np.uint32(z0 + _PRIME_Z)
  a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
  return (
    np.int64((x0 ^ a) & mask),
    np.int64((x1 ^ a) & mask),
    np.int64((x0 ^ b) & mask),
    np.int64((x1 ^ b) & mask),
    np.int64((x0 ^ c) & mask),
    np.int64((x1 ^ c) & mask),
    np.int64((x0 ^ d) & mask),
    np.int64((x1 ^ d) & mask),
  )


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def encode(table, resolutions, entries, coordinates, count, features, stride):
  """Writes the features of `count` points.

  Args:
    table: Features, flat [L * T * 2].
    resolutions: Cells along an axis int64 [L].
    entries: Entries a level, T.
    coordinates: Points in [0, 1]^3, flat [N * 3].
    count: Points to evaluate.
    features: Result; point n's features start at n * stride.
    stride: Distance between the points' rows in `features`.
  """
  for level in range(len(resolutions)):
    resolution = resolutions[level]
    scale = np.float32(resolution)
    top = resolution - 1
    start = level * entries * 2
    for n in range(count):
      px = coordinates[3 * n] * scale
      py = coordinates[3 * n + 1] * scale
      pz = coordinates[3 * n + 2] * scale
      ix = min(np.int64(px), top)
      iy = min(np.int64(py), top)
      iz = min(np.int64(pz), top)
      fx = px - np.float32(ix)
      fy = py - np.float32(iy)
      fz = pz - np.float32(iz)
      r0, r1, r2, r3, r4, r5, r6, r7 = _corner_rows(ix, iy, iz, resolution, entries)
      gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
      w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
      w0, w1, w2, w3 = gx * w00, fx * w00, gx * w10, fx * w10
      w4, w5, w6, w7 = gx * w01, fx * w01, gx * w11, fx * w11
      r0, r1, r2, r3 = start + 2 * r0, start + 2 * r1, start + 2 * r2, start + 2 * r3
      r4, r5, r6, r7 = start + 2 * r4, start + 2 * r5, start + 2 * r6, start + 2 * r7
      features[n * stride + 2 * level] = (
        w0 * table[r0]
        + w1 * table[r1]
        + w2 * table[r2]
        + w3 * table[r3]
        + w4 * table[r4]
        + w5 * table[r5]
        + w6 * table[r6]
        + w7 * table[r7]
      )
      features[n * stride + 2 * level + 1] = (
        w0 * table[r0 + 1]
        + w1 * table[r1 + 1]
        + w2 * table[r2 + 1]
        + w3 * table[r3 + 1]
        + w4 * table[r4 + 1]
        + w5 * table[r5 + 1]
        + w6 * table[r6 + 1]
        + w7 * table[r7 + 1]
      )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=KERNEL_CACHE)
def scatter_level(gradient, level, resolution, entries, coordinates, count, d_features, levels):
  """Adds the table's gradient of one level.

  One thread owns a level, so that no two threads write to the same entry and the sums have one
  order: a run can be repeated bit by bit.

  Args:
    gradient: Gradient of the table, flat [L * T * 2], added to.
    level, resolution, entries: The level, its cells along an axis, its entries.
    coordinates: Points in [0, 1]^3, flat [N * 3].
    count: Points.
    d_features: Gradient of the loss by the features, flat [N * 2 L].
    levels: Number of levels, L.
  """
  scale = np.float32(resolution)
  top = resolution - 1
  start = level * entries * 2
  for n in range(count):
    d0 = d_features[n * 2 * levels + 2 * level]
    d1 = d_features[n * 2 * levels + 2 * level + 1]
    px = coordinates[3 * n] * scale
    py = coordinates[3 * n + 1] * scale
    pz = coordinates[3 * n + 2] * scale
    ix = min(np.int64(px), top)
    iy = min(np.int64(py), top)
    iz = min(np.int64(pz), top)
    fx = px - np.float32(ix)
    fy = py - np.float32(iy)
    fz = pz - np.float32(iz)
    rows = _corner_rows(ix, iy, iz, resolution, entries)
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
    weights = (gx * w00, fx * w00, gx * w10, fx * w10, gx * w01, fx * w01, gx * w11, fx * w11)
    for corner in range(8):
      row = start + 2 * rows[corner]
      gradient[row] += weights[corner] * d0
      gradient[row + 1] += weights[corner] * d1


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=KERNEL_CACHE)
def adam(values, first, second, gradient, start, stop, rate, decay, beta1, beta2, epsilon, step):
  """Updates values[start:stop] by AdamW where the gradient is not zero, then clears the gradient.

  Entries that no sample touched keep their value and their moments, as in instant-ngp. The gradient
  of a mean or of a sum gives the same step.

  Args:
    values, first, second, gradient: Parameters, moments and gradient, flat.
    start, stop: Range to update; a multiple of 16 apart is fastest.
    rate: Learning rate.
    decay: Decoupled weight decay.
    beta1, beta2, epsilon: Adam's constants.
    step: Number of this step, from 1.

  Source: Loshchilov and Hutter 2019, algorithm 2.
  """
  one = _ONE
  rate = np.float32(rate)
  beta1, beta2, epsilon = np.float32(beta1), np.float32(beta2), np.float32(epsilon)
  correction1 = np.float32(1 / (1 - np.float64(beta1) ** step))
  correction2 = np.float32(1 / (1 - np.float64(beta2) ** step))
  keep = np.float32(one - rate * np.float32(decay))
  zero = np.float32(0)
  block = start
  while block < stop:
    end = min(block + 16, stop)
    touched = zero
    for i in range(block, end):
      touched += abs(gradient[i])
    if touched != zero:
      for i in range(block, end):
        g = gradient[i]
        m = beta1 * first[i] + (one - beta1) * g
        v = beta2 * second[i] + (one - beta2) * g * g
        moved = values[i] * keep - rate * correction1 * m / (np.sqrt(v * correction2) + epsilon)
        live = g != zero
        first[i] = m if live else first[i]
        second[i] = v if live else second[i]
        values[i] = moved if live else values[i]
        gradient[i] = zero
    block = end
