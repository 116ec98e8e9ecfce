"""Space squashing: the whole of space fits into the cube [-2, 2]^3, the unit cube stays as it is.

Source: Barron et al. 2022, Mip-NeRF 360, equation 10, with the maximum norm in place of the
Euclidean one, so that the squashed space is a cube and fills a grid.
"""

import jax
import jax.numpy as jnp


def contract(positions: jax.Array) -> jax.Array:
  """Squashes points [..., 3]: x where |x|_max <= 1, else (2 - 1 / |x|_max) x / |x|_max."""
  norm = jnp.maximum(jnp.max(jnp.abs(positions), axis=-1, keepdims=True), 1.0)
  return positions * ((2.0 - 1.0 / norm) / norm)


def grid_coordinates(positions: jax.Array) -> jax.Array:
  """Maps points [..., 3] of the unit frame to the hash grid's cube [0, 1]^3."""
  return (contract(positions) + 2.0) * 0.25
