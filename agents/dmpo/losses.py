"""The losses of distributional MPO: pure functions on arrays.

Sources: Abdolmaleki et al. 2018, "Maximum a Posteriori Policy Optimisation" and "Relative Entropy
Regularized Policy Iteration" (https://arxiv.org/abs/1812.02256); Abdolmaleki et al. 2020, "A
Distributional View on Multi-Objective Policy Optimization" (the action penalty); Hoffman et al.
2020, "Acme" (the reference implementation).

Shape letters: N sampled actions, B states, D action dimensions. Weights [B] are how much a state
counts: 1, or 0 for padding.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo.shapes import check_shapes

_MIN_DUAL = 1e-8  # added to softplus(raw), reference implementation
_MIN_RAW_DUAL = -18.0  # smallest raw value of a dual variable, reference implementation


class DualParams(NamedTuple):
  """Raw dual variables; softplus(raw) + 1e-8 is what the losses use."""

  temperature: jax.Array  # []
  alpha_mean: jax.Array  # [D], or [1] with one bound for all dimensions
  alpha_stddev: jax.Array  # same shape
  penalty_temperature: jax.Array  # []


class MpoEpsilons(NamedTuple):
  """The bounds of MPO [nat]."""

  epsilon: float
  epsilon_mean: float
  epsilon_stddev: float
  epsilon_penalty: float


class Gaussian(NamedTuple):
  """A diagonal Gaussian: mean and standard deviation [..., D]."""

  mean: jax.Array
  stddev: jax.Array


def init_duals(
  action_size: int,
  *,
  log_temperature: float,
  log_alpha_mean: float,
  log_alpha_stddev: float,
  per_dimension: bool = True,
) -> DualParams:
  """Returns the dual variables at the start of training."""
  size = action_size if per_dimension else 1
  return DualParams(
    temperature=jnp.asarray(log_temperature, jnp.float32),
    alpha_mean=jnp.full((size,), log_alpha_mean, jnp.float32),
    alpha_stddev=jnp.full((size,), log_alpha_stddev, jnp.float32),
    penalty_temperature=jnp.asarray(log_temperature, jnp.float32),
  )


def positive(raw: jax.Array) -> jax.Array:
  """Maps raw dual variables to positive ones: softplus(raw) + 1e-8."""
  return jax.nn.softplus(raw) + _MIN_DUAL


def clip_duals(duals: DualParams) -> DualParams:
  """Keeps raw values at -18 or more, so that softplus does not underflow."""
  return jax.tree.map(lambda raw: jnp.maximum(raw, _MIN_RAW_DUAL), duals)


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
  """Mean over the leading axis of values [B, ...] with weights [B]."""
  total = jnp.maximum(weights.sum(), 1e-8)
  return jnp.tensordot(weights, values, axes=(0, 0)) / total


def log_prob(gaussian: Gaussian, actions: jax.Array) -> jax.Array:
  """Log-density of actions [..., D] under a diagonal Gaussian; sums over D."""
  z = (actions - gaussian.mean) / gaussian.stddev
  return jnp.sum(-0.5 * z**2 - jnp.log(gaussian.stddev) - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def kl_per_dimension(p: Gaussian, q: Gaussian) -> jax.Array:
  """KL(p || q) of each dimension [..., D] of two diagonal Gaussians."""
  return (
    jnp.log(q.stddev / p.stddev) + (p.stddev**2 + (p.mean - q.mean) ** 2) / (2 * q.stddev**2) - 0.5
  )


def improvement_weights(
  values: jax.Array, temperature: jax.Array, epsilon: float, weights: jax.Array
) -> tuple[jax.Array, jax.Array]:
  """The E-step: weights of the samples, and the dual loss of its temperature.

  w_n = softmax_n(Q_n / eta);  L_eta = eta (epsilon + mean_s logsumexp_n(Q_n / eta) - log N).

  Args:
    values: objective of each sample [N, B].
    temperature: eta, positive [].
    epsilon: bound on the KL between the reweighted and the sampling policy.
    weights: how much a state counts [B].

  Returns:
    The samples' weights [N, B], without gradient, and the loss of the temperature [].
  """
  check_shapes(values=(values, 2), temperature=(temperature, 0), weights=(weights, 1))
  scaled = jax.lax.stop_gradient(values) / temperature
  sample_weights = jax.lax.stop_gradient(jax.nn.softmax(scaled, axis=0))
  log_mean = jax.nn.logsumexp(scaled, axis=0) - jnp.log(values.shape[0])
  return sample_weights, temperature * (epsilon + weighted_mean(log_mean, weights))


def out_of_bounds_cost(actions: jax.Array) -> jax.Array:
  """Cost of actions [..., D] outside [-1, 1]: -||a - clip(a, -1, 1)||_2."""
  excess = actions - jnp.clip(actions, -1.0, 1.0)
  return -jnp.linalg.norm(excess, axis=-1)


def _kl_penalty_and_dual_loss(
  kl: jax.Array, alpha: jax.Array, epsilon: float
) -> tuple[jax.Array, jax.Array]:
  """sum_d sg(alpha_d) KL_d, and sum_d alpha_d (epsilon - sg(KL_d)), for mean KLs [D or 1]."""
  penalty = jnp.sum(jax.lax.stop_gradient(alpha) * kl)
  dual = jnp.sum(alpha * (epsilon - jax.lax.stop_gradient(kl)))
  return penalty, dual


def mpo_loss(
  duals: DualParams,
  online: Gaussian,
  *,
  target: Gaussian,
  actions: jax.Array,
  values: jax.Array,
  weights: jax.Array,
  epsilons: MpoEpsilons,
  action_penalization: bool = True,
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """The policy's loss and that of the dual variables, decoupled into mean and deviation.

  L_pi = -mean_s sum_n w_n [log N(a_n; mu, sigma') + log N(a_n; mu', sigma)]
         + sum_d sg(alpha_d) KL_d + the losses of temperatures and multipliers,
  where mu', sigma' are the target's. The KLs are those from the target to
  N(mu, sigma') and to N(mu', sigma).

  Args:
    duals: raw dual variables; alphas of shape [D] bound each dimension, of [1] their sum.
    online: policy that learns [B, D].
    target: policy that the actions were drawn from [B, D]; no gradient flows into it.
    actions: samples [N, B, D].
    values: the target critic's value of each sample [N, B].
    weights: how much a state counts [B].
    epsilons: the bounds.
    action_penalization: adds the weights of the out-of-bounds objective.

  Returns:
    The loss [] and metrics (scalars).
  """
  check_shapes(
    mean=(online.mean, 2),
    stddev=(online.stddev, 2),
    target_mean=(target.mean, 2),
    actions=(actions, 3),
    values=(values, 2),
    weights=(weights, 1),
  )
  target = jax.lax.stop_gradient(target)
  temperature = positive(duals.temperature)
  sample_weights, loss_temperature = improvement_weights(
    values, temperature, epsilons.epsilon, weights
  )
  metrics = {
    "temperature": temperature,
    "loss_temperature": loss_temperature,
    "kl_q": _nonparametric_kl(sample_weights, weights),
  }
  if action_penalization:
    penalty_temperature = positive(duals.penalty_temperature)
    cost = out_of_bounds_cost(actions)
    penalty_weights, loss_penalty = improvement_weights(
      cost, penalty_temperature, epsilons.epsilon_penalty, weights
    )
    sample_weights = sample_weights + penalty_weights
    loss_temperature = loss_temperature + loss_penalty
    metrics["penalty_temperature"] = penalty_temperature
    metrics["action_excess"] = weighted_mean(-cost.mean(0), weights)

  fixed_stddev = Gaussian(online.mean, target.stddev)
  fixed_mean = Gaussian(target.mean, online.stddev)
  log_probs = log_prob(fixed_stddev, actions) + log_prob(fixed_mean, actions)  # [N, B]
  loss_policy = -weighted_mean(jnp.sum(sample_weights * log_probs, axis=0), weights)

  alpha_mean, alpha_stddev = positive(duals.alpha_mean), positive(duals.alpha_stddev)
  kl_mean = weighted_mean(kl_per_dimension(target, fixed_stddev), weights)  # [D]
  kl_stddev = weighted_mean(kl_per_dimension(target, fixed_mean), weights)
  if alpha_mean.shape[0] != kl_mean.shape[0]:  # one bound for the sum over dimensions
    kl_mean, kl_stddev = kl_mean.sum(keepdims=True), kl_stddev.sum(keepdims=True)
  penalty_mean, dual_mean = _kl_penalty_and_dual_loss(kl_mean, alpha_mean, epsilons.epsilon_mean)
  penalty_stddev, dual_stddev = _kl_penalty_and_dual_loss(
    kl_stddev, alpha_stddev, epsilons.epsilon_stddev
  )
  loss_kl, loss_alpha = penalty_mean + penalty_stddev, dual_mean + dual_stddev
  loss = loss_policy + loss_kl + loss_alpha + loss_temperature
  metrics |= {
    "loss_policy": loss_policy,
    "loss_kl": loss_kl,
    "loss_alpha": loss_alpha,
    "kl_mean": kl_mean.mean(),
    "kl_stddev": kl_stddev.mean(),
    "alpha_mean": alpha_mean.mean(),
    "alpha_stddev": alpha_stddev.mean(),
    "policy_stddev": weighted_mean(online.stddev.mean(-1), weights),
    "q_mean": weighted_mean(values.mean(0), weights),
    "q_spread": weighted_mean(values.std(0), weights),
  }
  return loss, metrics


def _nonparametric_kl(sample_weights: jax.Array, weights: jax.Array) -> jax.Array:
  """KL [nat] between the reweighted and the uniform distribution over the samples."""
  n = sample_weights.shape[0]
  kl = jnp.sum(sample_weights * jnp.log(n * sample_weights + 1e-8), axis=0)
  return weighted_mean(kl, weights)
