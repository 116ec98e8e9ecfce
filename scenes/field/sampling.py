"""Where samples lie on rays and what light their intervals take: step functions along a ray.

Normalised distances s in [0, 1] are uniform in t up to the unit distance and uniform in 1/t beyond.
Shapes: R rays, N intervals, M new intervals.
"""

import jax
import jax.numpy as jnp

_TINY = 1e-7
_PADDING = 1e-5  # added to the weights: a ray without matter is sampled evenly


def spacing(distances: jax.Array) -> jax.Array:
  """Normalised distance: t / 2 up to t = 1, 1 - 1 / (2 t) beyond.

  Source: Barron et al. 2022, Mip-NeRF 360, section 3 (linear in the squashed space).
  """
  far = 1.0 - 0.5 / jnp.maximum(distances, 1.0)
  return jnp.where(distances < 1.0, 0.5 * distances, far)


def inverse_spacing(normalised: jax.Array) -> jax.Array:
  """Inverts `spacing` for s in [0, 1)."""
  far = 0.5 / jnp.maximum(1.0 - normalised, _TINY)
  return jnp.where(normalised < 0.5, 2.0 * normalised, far)


def stratified(key: jax.Array, rays: int, intervals: int, *, near: float, far: float) -> jax.Array:
  """Draws interval edges [R, N + 1] in normalised distance, one in every stratum, sorted."""
  lower, upper = spacing(jnp.asarray(near)), spacing(jnp.asarray(far))
  jitter = jax.random.uniform(key, (rays, intervals + 1))
  edges = (jnp.arange(intervals + 1) + jitter) / (intervals + 1)
  return lower + (upper - lower) * edges


def interval_weights(densities: jax.Array, lengths: jax.Array) -> jax.Array:
  """Share of light that every interval takes: w_i = T_i (1 - exp(-sigma_i l_i)) [..., N].

  Source: Mildenhall et al. 2020, NeRF, equation 3.
  """
  depth = densities * lengths
  before = jnp.cumsum(depth, axis=-1) - depth
  return jnp.exp(-before) * -jnp.expm1(-depth)


def dilate(edges: jax.Array, weights: jax.Array, *, dilation: float) -> tuple[jax.Array, jax.Array]:
  """Widens a step function: its density becomes the maximum within `dilation` on either side.

  Args:
    edges: Sorted edges [..., N + 1].
    weights: Weights of the intervals [..., N].
    dilation: Half-width of the window, in the units of the edges.

  Returns:
    edges [..., 3 N + 1] and weights [..., 3 N] with the same sum as the weights given.

  Source: Barron et al. 2022, Mip-NeRF 360, supplement, "Dilation".
  """
  density = weights / jnp.maximum(jnp.diff(edges), _TINY)
  lower, upper = edges[..., :-1] - dilation, edges[..., 1:] + dilation
  new_edges = jnp.sort(jnp.concatenate([edges, lower, upper], axis=-1), axis=-1)
  new_edges = jnp.clip(new_edges, edges[..., :1], edges[..., -1:])
  middle = 0.5 * (new_edges[..., 1:] + new_edges[..., :-1])
  inside = (lower[..., None, :] <= middle[..., None]) & (middle[..., None] < upper[..., None, :])
  density = jnp.max(jnp.where(inside, density[..., None, :], 0.0), axis=-1)
  new_weights = density * jnp.diff(new_edges)
  total = jnp.sum(weights, axis=-1, keepdims=True)
  spread = jnp.maximum(jnp.sum(new_weights, axis=-1, keepdims=True), _TINY)
  return new_edges, new_weights * (total / spread)


def resample(key: jax.Array, edges: jax.Array, weights: jax.Array, intervals: int) -> jax.Array:
  """Draws new interval edges from a step function by inverting its cumulative sum.

  Args:
    key: Randomness; the draw is stratified.
    edges: Sorted edges [R, N + 1].
    weights: Weights of the intervals [R, N]; not normalised.
    intervals: Intervals to return, M.

  Returns:
    Sorted edges [R, M + 1], without gradient.

  Source: Barron et al. 2022, Mip-NeRF 360, section 3 and supplement.
  """
  weights = weights + _PADDING * jnp.diff(edges)
  mass = weights / jnp.sum(weights, axis=-1, keepdims=True)
  cumulative = jnp.minimum(jnp.cumsum(mass, axis=-1), 1.0)
  cumulative = jnp.concatenate([jnp.zeros_like(cumulative[..., :1]), cumulative], axis=-1)
  jitter = jax.random.uniform(key, (edges.shape[0], intervals + 1))
  wanted = (jnp.arange(intervals + 1) + jitter) / (intervals + 1)
  drawn = jax.vmap(jnp.interp)(wanted, cumulative, edges)
  return jax.lax.stop_gradient(jnp.sort(drawn, axis=-1))
