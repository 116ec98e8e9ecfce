"""n-step targets from trajectories, and the categorical critic's loss.

Sources: Bellemare et al. 2017, "A Distributional Perspective on Reinforcement Learning"
(https://arxiv.org/abs/1707.06887), section 4; Byravan et al. 2022 (NeRF2Real), appendix, DMPO:
"N-step returns are estimated from multi-step trajectories inside the critic loss".

Shape letters: T steps of a trajectory, B states or trajectories, K atoms. A trajectory's step t
holds observation t and the action taken there; reward and discount `_t` (array index t - 1) follow
the action of step t - 1. Rewards and discounts therefore have T - 1 entries.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo.shapes import check_shapes


class NStep(NamedTuple):
  """Pieces of n-step targets for the steps 0 .. T - 2 of one trajectory."""

  returns: jax.Array  # [T - 1] discounted sum of the rewards up to the bootstrap state
  discounts: jax.Array  # [T - 1] factor on the bootstrap state's value
  bootstrap: jax.Array  # [T - 1] int, index of the bootstrap state


def n_step_targets(reward_t: jax.Array, discount_t: jax.Array, last: jax.Array, *, n: int) -> NStep:
  """Sums rewards over at most n steps, cut at the trajectory's last step.

  G_t = sum_{i<k} (prod_{j<i} gamma_{t+j+1}) r_{t+i+1},  k = min(n, last - t); the bootstrap state
  is t + k. Entries at and beyond `last` are padding and come out as zeros.

  Args:
    reward_t: rewards [T - 1].
    discount_t: the agent's discount times the environment's [T - 1].
    last: index of the last step that is not padding [].
    n: most rewards to sum.
  """
  check_shapes(reward_t=(reward_t, 1), discount_t=(discount_t, 1), last=(last, 0))
  count = reward_t.shape[0]
  steps = jnp.arange(count)
  returns, factor = jnp.zeros(count), jnp.ones(count)
  for i in range(n):
    index = jnp.minimum(steps + i, count - 1)
    inside = steps + i < last
    returns = returns + jnp.where(inside, factor * reward_t[index], 0.0)
    factor = jnp.where(inside, factor * discount_t[index], factor)
  bootstrap = jnp.minimum(steps + n, last)
  return NStep(returns, jnp.where(steps < last, factor, 0.0), bootstrap)


def categorical_project(
  positions: jax.Array, probabilities: jax.Array, atoms: jax.Array
) -> jax.Array:
  """Projects a categorical distribution onto evenly spaced atoms (L2 of the CDFs, Cramer).

  Every position is clipped to the support; its mass is split between its two neighbours by
  nearness: sum_j clip(1 - |z_j - z_i| / dz, 0, 1) p_j.

  Args:
    positions: where the mass sits [B, K].
    probabilities: the mass [B, K].
    atoms: the support, rising in even steps [K].

  Returns:
    Probabilities on the atoms [B, K].
  """
  check_shapes(positions=(positions, 2), probabilities=(probabilities, 2), atoms=(atoms, 1))
  spacing = (atoms[-1] - atoms[0]) / (atoms.shape[0] - 1)
  place = (jnp.clip(positions, atoms[0], atoms[-1]) - atoms[0]) / spacing  # in steps of atoms
  index = jnp.arange(atoms.shape[0])
  share = jnp.clip(1.0 - jnp.abs(place[:, None, :] - index[None, :, None]), 0.0, 1.0)
  return jnp.einsum("bij,bj->bi", share, probabilities)


def categorical_critic_loss(
  logits_tm1: jax.Array,
  *,
  returns: jax.Array,
  discounts: jax.Array,
  target_probabilities: jax.Array,
  atoms: jax.Array,
) -> jax.Array:
  """Cross-entropy [B] between the projected n-step target and the critic's distribution.

  Args:
    logits_tm1: the critic's logits at state and action [B, K].
    returns: n-step sums of rewards [B].
    discounts: factor on the bootstrap value [B].
    target_probabilities: the target critic's at the bootstrap state, averaged over the sampled
      actions [B, K].
    atoms: the support [K].
  """
  check_shapes(logits_tm1=(logits_tm1, 2), returns=(returns, 1), discounts=(discounts, 1))
  positions = returns[:, None] + discounts[:, None] * atoms[None, :]
  target = jax.lax.stop_gradient(categorical_project(positions, target_probabilities, atoms))
  return -jnp.sum(target * jax.nn.log_softmax(logits_tm1, axis=-1), axis=-1)
