"""What the field's networks see: hash-grid features, spherical harmonics, a sample's extent.

Shapes: L levels, T entries a level, F features an entry.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

HASH_PRIMES = (1, 2654435761, 805459861)  # Mueller et al. 2022, equation 4
HARMONICS = 9  # numbers that `spherical_harmonics` gives
_VARIANCE_FLOOR = 1e-10  # chosen: a standard deviation of 1e-5 units, far below a pixel's


def grid_resolutions(base: int, growth: float, levels: int) -> tuple[int, ...]:
  """Returns the number of cells along an axis for every level: floor(base * growth^l).

  Source: Mueller et al. 2022, Instant neural graphics primitives, equation 2.
  """
  return tuple(int(np.floor(base * growth**level + 1e-9)) for level in range(levels))


def is_dense(resolution: int, entries: int) -> bool:
  """Whether a level has an entry of its own for every grid vertex (else they are hashed)."""
  return (resolution + 1) ** 3 <= entries


def level_rows(resolutions: Sequence[int], entries: int) -> np.ndarray:
  """Returns what kernels need to index the levels' tables: uint32 [4, L].

  The rows are the strides of y and z (x has 1), a mask and the number of cells along an axis. A
  vertex has row x + y stride_y + z stride_z where the mask is 0 (a dense level), else
  (x ^ y stride_y ^ z stride_z) & mask, see `entry_index`.
  """
  columns = [
    (cells + 1, (cells + 1) ** 2, 0, cells)
    if is_dense(cells, entries)
    else (*HASH_PRIMES[1:], entries - 1, cells)
    for cells in resolutions
  ]
  return np.array(columns, np.uint32).T.copy()


def entry_index(vertices: jax.Array, *, resolution: int, entries: int) -> jax.Array:
  """Maps grid vertices uint32 [..., 3] of a level to rows of its table [...]."""
  x, y, z = vertices[..., 0], vertices[..., 1], vertices[..., 2]
  if is_dense(resolution, entries):
    side = jnp.uint32(resolution + 1)
    return x + side * (y + side * z)
  hashed = x ^ (y * jnp.uint32(HASH_PRIMES[1])) ^ (z * jnp.uint32(HASH_PRIMES[2]))
  return hashed & jnp.uint32(entries - 1)


def hash_encode(
  table: jax.Array, coordinates: jax.Array, *, resolutions: Sequence[int]
) -> jax.Array:
  """Interpolates the levels' features trilinearly.

  Args:
    table: Features [L, T, F]; T is a power of two.
    coordinates: Points in [0, 1]^3 [..., 3].
    resolutions: Cells along an axis, one number a level.

  Returns:
    Features [..., L * F], level by level.

  Source: Mueller et al. 2022, section 3.
  """
  levels, entries, _ = table.shape
  if len(resolutions) != levels:
    raise ValueError(f"The table has {levels} levels but {len(resolutions)} resolutions are given.")
  features = []
  for level, resolution in enumerate(resolutions):
    scaled = coordinates * resolution
    lower = jnp.clip(jnp.floor(scaled), 0, resolution - 1)
    fraction = scaled - lower
    lower = lower.astype(jnp.uint32)
    total: Any = 0.0
    for corner in range(8):
      offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1], np.uint32)
      weight = jnp.prod(jnp.where(offset == 1, fraction, 1 - fraction), axis=-1)
      index = entry_index(lower + offset, resolution=resolution, entries=entries)
      total = total + weight[..., None] * table[level][index]
    features.append(total)
  return jnp.concatenate(features, axis=-1)


def spherical_harmonics(directions: jax.Array) -> jax.Array:
  """Real spherical harmonics of degree 0 to 2 of unit directions [..., 3]: [..., 9]."""
  x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
  return jnp.stack(
    [
      jnp.full_like(x, 0.28209479),
      -0.48860251 * y,
      0.48860251 * z,
      -0.48860251 * x,
      1.09254843 * x * y,
      -1.09254843 * y * z,
      0.31539157 * (3 * z * z - 1),
      -1.09254843 * x * z,
      0.54627421 * (x * x - y * y),
    ],
    axis=-1,
  )


def blur_footprint(blur: jax.Array) -> jax.Array:
  """Factor 1 + 12 blur^2 by which a Gaussian blur [pixel] widens a pixel's variance.

  Variances add, because a pixel is a box of variance 1/12: it is the blur that equals a coarser
  camera's pixel. The paper widens it by 1 + blur - sigma_min instead (NeRF2Real, section NeRF
  training), which no camera's pixel equals.
  """
  return 1.0 + 12.0 * blur * blur


def sample_variance(
  directions: jax.Array,
  distances: jax.Array,
  lengths: jax.Array,
  *,
  pixel_angle: float,
  footprint: jax.Array | float = 1.0,
) -> jax.Array:
  """Diagonal variance of the stretch of a pixel's cone that a sample stands for.

  footprint (pixel_angle s)^2 / 12 (1 - d_i^2) + length^2 / 12 d_i^2

  Args:
    directions: Unit directions [..., 3].
    distances: Distances from the camera s [...].
    lengths: Lengths of the intervals [...].
    pixel_angle: Angle that a pixel spans [rad].
    footprint: Widening by blur, see `blur_footprint` [...].

  Returns:
    Variances [..., 3].

  Source: Barron et al. 2021, Mip-NeRF, equations 7 to 16, with a box-shaped pixel.
  """
  along = directions * directions
  across = footprint * (pixel_angle * distances) ** 2 / 12.0
  return across[..., None] * (1 - along) + (lengths * lengths / 12.0)[..., None] * along


def variance_features(variances: jax.Array) -> jax.Array:
  """Scales variances [..., 3] to network inputs: log2(standard deviation) / 10 + 1."""
  return 0.05 * jnp.log2(variances + _VARIANCE_FLOOR) + 1.0
