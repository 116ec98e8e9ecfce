"""Losses of the field's training, each a mean over rays. Shapes: R rays, N and M intervals."""

import jax
import jax.numpy as jnp

_EPSILON = 1e-7


def charbonnier(color: jax.Array, target: jax.Array, *, padding: float) -> jax.Array:
  """Robust colour loss: mean of sqrt((c - c*)^2 + padding^2) over colours [R, 3].

  Source: Charbonnier et al. 1994; Barron et al. 2022, Mip-NeRF 360, section 5.
  """
  return jnp.mean(jnp.sqrt(jnp.square(color - target) + padding * padding))


def distortion(weights: jax.Array, edges: jax.Array) -> jax.Array:
  """Spread of a ray's weights, in O(N).

  sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_{i+1} - s_i), with midpoints m.

  Args:
    weights: Share of light of every interval [R, N].
    edges: Sorted normalised distances [R, N + 1].

  Source: Barron et al. 2022, Mip-NeRF 360, equation 15; the linear form: Sun et al. 2022, DVGO v2.
  """
  return jnp.mean(
    distortion_of_intervals(
      weights, 0.5 * (edges[..., 1:] + edges[..., :-1]), jnp.diff(edges, axis=-1)
    )
  )


def distortion_of_intervals(
  weights: jax.Array, middles: jax.Array, lengths: jax.Array
) -> jax.Array:
  """`distortion` of intervals that need not touch, a number a ray [R]; middles are sorted."""
  moments = weights * middles
  below = jnp.cumsum(weights, axis=-1) - weights
  moment_below = jnp.cumsum(moments, axis=-1) - moments
  between = 2.0 * jnp.sum(moments * below - weights * moment_below, axis=-1)
  return between + jnp.sum(weights * weights * lengths, axis=-1) / 3.0


def anchor(weights: jax.Array, edges: jax.Array, goals: jax.Array, known: jax.Array) -> jax.Array:
  """Mean distance of a ray's light from where a localised point lies.

  sum_i w_i |m_i - goal|, and 1 - goal for the light that hits nothing; 0 for rays without a goal.

  Args:
    weights, edges: The field's step function [R, N], [R, N + 1]; distances are normalised.
    goals: Normalised distance of the point on each ray [R].
    known: Which rays have a goal, bool [R].

  Source: a mean absolute error in place of the likelihood of Deng et al. 2022, DS-NeRF. Chosen: it
  needs no width of the distribution about a point.
  """
  middles = 0.5 * (edges[..., 1:] + edges[..., :-1])
  off = jnp.sum(weights * jnp.abs(middles - goals[:, None]), axis=-1)
  lost = (1.0 - jnp.sum(weights, axis=-1)) * (1.0 - goals)
  return jnp.mean(jnp.where(known, off + lost, 0.0))


def interlevel(
  edges: jax.Array, weights: jax.Array, proposal_edges: jax.Array, proposal_weights: jax.Array
) -> jax.Array:
  """Penalty where the field's weights exceed what the proposal allows for their interval.

  sum_i max(0, w_i - bound_i)^2 / w_i; the bound is the sum of the proposal's intervals that overlap
  interval i. Gradient flows to the proposal only.

  Args:
    edges, weights: The field's step function [R, N + 1], [R, N].
    proposal_edges, proposal_weights: The proposal's [R, M + 1], [R, M].

  Source: Barron et al. 2022, Mip-NeRF 360, equations 12 and 13.
  """
  edges, weights = jax.lax.stop_gradient(edges), jax.lax.stop_gradient(weights)
  cumulative = jnp.cumsum(proposal_weights, axis=-1)
  cumulative = jnp.concatenate([jnp.zeros_like(cumulative[..., :1]), cumulative], axis=-1)
  search = jax.vmap(lambda sorted_edges, x: jnp.searchsorted(sorted_edges, x, side="right"))
  last = proposal_edges.shape[-1] - 1
  lower = jnp.clip(search(proposal_edges, edges[..., :-1]) - 1, 0, last)
  upper = jnp.clip(search(proposal_edges, edges[..., 1:]), 0, last)
  bound = jnp.take_along_axis(cumulative, upper, -1) - jnp.take_along_axis(cumulative, lower, -1)
  excess = jnp.maximum(weights - bound, 0.0)
  return jnp.mean(jnp.sum(excess * excess / (weights + _EPSILON), axis=-1))
