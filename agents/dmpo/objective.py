"""The agent's objective: MPO for the policy, a categorical critic, likelihood for the belief.

Data flow: batch of trajectories -> augmentation, scaling -> policy and target policy over time ->
N actions of the target policy at every state -> the target critic's distributions -> n-step
categorical loss for the critic, MPO for the policy, likelihood for the belief; where a run began
with a policy, a penalty on the KL from it.

Shape letters: B trajectories, T time, N samples, A action, K atoms, C copies, F features, S + P
inputs of the critic.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo import augmentation, belief, losses, networks, returns, scaling
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.specs import Layout, planar_pose

Metrics = dict[str, jax.Array]


class _Evaluation(NamedTuple):
  """What the losses share; no gradient flows into it."""

  inputs: dict[str, Any]  # of the policy networks
  critic_inputs: jax.Array  # [B, T, S + P]
  target: networks.PolicyOutput
  actions: jax.Array  # of the target policy [N, B, T, A]
  probabilities: jax.Array  # of the target critic for them [N, B, T, K]


def _evaluate(
  target_policy: Params,
  target_critic: Params,
  *,
  batch: Mapping[str, Any],
  key: jax.Array,
  config: DmpoConfig,
  scales: Params | None,
) -> _Evaluation:
  """Samples the target policy's actions and evaluates them; see `total_loss`."""
  view_key, sample_key = jax.random.split(key)
  state = scaling.apply(scales or {}, "state", batch["state"])
  privileged = scaling.apply(scales or {}, "privileged", batch["privileged"])
  inputs: dict[str, Any] = {"state": state, "images": None, "initial": None}
  for name in {"features", "embedding"} & set(batch):  # [B, T, C, F], a copy for each trajectory
    stored = batch[name]
    copies = jax.random.randint(view_key, (stored.shape[0], 1, 1, 1), 0, stored.shape[2])
    inputs[name] = jnp.take_along_axis(stored, copies, axis=2).squeeze(2).astype(jnp.float32)
  if "image" in batch:
    images = batch["image"].astype(jnp.float32) / 255.0
    inputs["images"] = augmentation.augment(view_key, images, config.augmentation)
  if "lstm_hidden" in batch:
    inputs["initial"] = LstmState(batch["lstm_hidden"], batch["lstm_cell"])
    inputs["burn_in"] = batch.get("burn_in")
  target = networks.unroll_policy(target_policy, config.network, **inputs)
  target = jax.lax.stop_gradient(target)

  # One set of sampled actions serves the E-step and the bootstrap.
  noise = jax.random.normal(sample_key, (config.num_samples, *target.action.mean.shape))
  actions = target.action.mean + target.action.stddev * noise
  critic_inputs = jnp.concatenate([state, privileged], axis=-1)
  logits = networks.critic_logits(target_critic, critic_inputs, actions)
  probabilities = jax.lax.stop_gradient(jax.nn.softmax(logits, axis=-1))
  return _Evaluation(inputs, critic_inputs, target, actions, probabilities)


def critic_objective(
  critic: Params,
  target_policy: Params,
  target_critic: Params,
  *,
  batch: Mapping[str, Any],
  key: jax.Array,
  config: DmpoConfig,
  scales: Params | None = None,
) -> tuple[jax.Array, Metrics]:
  """The critic's loss alone, while the policy rests; see `total_loss`."""
  found = _evaluate(
    target_policy, target_critic, batch=batch, key=key, config=config, scales=scales
  )
  loss, metrics = critic_loss(
    critic,
    critic_inputs=found.critic_inputs,
    batch=batch,
    target_probabilities=found.probabilities.mean(0),
    config=config,
  )
  return loss, metrics | {"loss": loss}


def total_loss(
  trained: tuple[Params, Params, losses.DualParams, Params],
  target_policy: Params,
  target_critic: Params,
  *,
  batch: Mapping[str, Any],
  key: jax.Array,
  config: DmpoConfig,
  layout: Layout,
  scales: Params | None = None,
  student: Params | None = None,
) -> tuple[jax.Array, Metrics]:
  """Sum of the losses of policy, duals, critic and belief; each reaches its own parameters only.

  Args:
    trained: parameters of policy, critic, duals and belief.
    target_policy: parameters of the target policy.
    target_critic: parameters of the target critic.
    batch: `state` [B, T, S], `privileged` [B, T, P], `action` [B, T, A], `reward` and `discount`
      [B, T], `last` [B]; `image` uint8 [B, T, H, W, 3] or `features` [B, T, C, F], `lstm_hidden`
      and `lstm_cell` [B, U], or in place of these `embedding` [B, T, C, U]; `burn_in` [B], steps
      that only unroll the LSTM; `student_weight` [].
    key: random key.
    config: the agent's settings.
    layout: the environment's layout.
    scales: of the observations, from `scaling`; none if empty.
    student: parameters of the policy that the learning one is drawn to, by `student_weight`; none
      if empty.
  """
  policy, critic, duals, beliefs = trained
  found = _evaluate(
    target_policy, target_critic, batch=batch, key=key, config=config, scales=scales
  )
  online = networks.unroll_policy(policy, config.network, **found.inputs)
  size, time = batch["reward"].shape
  flat = size * time
  last = batch["last"]
  loss_critic, metrics = critic_loss(
    critic,
    critic_inputs=found.critic_inputs,
    batch=batch,
    target_probabilities=found.probabilities.mean(0),
    config=config,
  )
  unrolled = jnp.arange(time) >= burn_in(batch)[:, None]  # [B, T]: the LSTM's state is known
  weights = (policy_weights(batch["discount"], last) * unrolled).reshape(flat)
  loss_mpo, mpo_metrics = losses.mpo_loss(
    duals,
    _flatten_gaussian(online.action, flat),
    target=_flatten_gaussian(found.target.action, flat),
    actions=found.actions.reshape(config.num_samples, flat, -1),
    values=(found.probabilities @ networks.atoms(config.network)).reshape(config.num_samples, flat),
    weights=weights,
    epsilons=losses.MpoEpsilons(
      config.epsilon, config.epsilon_mean, config.epsilon_stddev, config.epsilon_action_penalty
    ),
    action_penalization=config.action_penalization,
  )
  metrics |= mpo_metrics
  loss = loss_critic + loss_mpo
  if student:
    begun = networks.unroll_policy(student, config.network, **found.inputs)
    kl = losses.kl_per_dimension(online.action, jax.lax.stop_gradient(begun.action)).sum(-1)
    metrics["student_kl"] = losses.weighted_mean(kl.reshape(flat), weights)
    metrics["student_weight"] = batch["student_weight"]
    loss = loss + batch["student_weight"] * metrics["student_kl"]
  if beliefs:
    present = ((jnp.arange(time) <= last[:, None]) & unrolled).astype(jnp.float32)
    loss_belief, belief_metrics = _belief_loss(
      beliefs, online.embedding, batch["privileged"], weights=present, layout=layout
    )
    loss, metrics = loss + loss_belief, metrics | belief_metrics
  metrics["loss"] = loss
  return loss, metrics


def burn_in(batch: Mapping[str, Any]) -> jax.Array:
  """Steps of each trajectory [B] that only unroll the LSTM."""
  return batch.get("burn_in", jnp.zeros_like(batch["last"]))


def _belief_loss(
  beliefs: Params,
  embedding: jax.Array,
  privileged: jax.Array,
  *,
  weights: jax.Array,
  layout: Layout,
) -> tuple[jax.Array, Metrics]:
  """Negative log-likelihood of the true pose under the belief from the embedding [B, T, U]."""
  assert layout.pose_columns is not None
  flat = weights.size
  pose = planar_pose(privileged, layout.pose_columns, jnp).reshape(flat, 3)
  predicted = belief.predict(beliefs, embedding.reshape(flat, -1))
  loss = -losses.weighted_mean(belief.log_likelihood(predicted, pose), weights.reshape(flat))
  error = belief.localisation_error(predicted, pose)
  return loss, {
    "loss_belief": loss,
    "belief_error": losses.weighted_mean(error, weights.reshape(flat)),
  }


def policy_weights(discount: jax.Array, last: jax.Array) -> jax.Array:
  """How much each state counts in the policy's loss [B, T]: 1, or 0 for padding and terminal ones.

  Nothing follows a terminal state: the critic is never trained there, so that its values rank
  no actions. A state at which a trajectory was cut counts; another one goes on from it.

  Args:
    discount: the environment's after the action of each step [B, T], 0 where it terminates.
    last: index of each trajectory's last observation [B].
  """
  steps = jnp.arange(discount.shape[1])
  into_last = jnp.take_along_axis(discount, jnp.maximum(last - 1, 0)[:, None], axis=1)
  counts = (steps < last[:, None]) | ((steps == last[:, None]) & (into_last != 0))
  return counts.astype(jnp.float32)


def critic_loss(
  critic: Params,
  *,
  critic_inputs: jax.Array,
  batch: Mapping[str, Any],
  target_probabilities: jax.Array,
  config: DmpoConfig,
) -> tuple[jax.Array, Metrics]:
  """The categorical n-step loss over the transitions of trajectories, padding left out.

  So are transitions that bootstrap during the burn-in, where the policy's LSTM is not yet right.

  Args:
    critic: parameters that learn.
    critic_inputs: the critic's observations [B, T, S + P].
    batch: `action` [B, T, A], `reward` and `discount` [B, T], `last` [B], `burn_in` [B].
    target_probabilities: the target critic's distribution at every state [B, T, K].
    config: the agent's settings.
  """
  time = critic_inputs.shape[1]
  steps = jax.vmap(lambda r, d, last: returns.n_step_targets(r, d, last, n=config.n_step))(
    batch["reward"][:, :-1], config.discount * batch["discount"][:, :-1], batch["last"]
  )
  bootstrap = jnp.take_along_axis(target_probabilities, steps.bootstrap[..., None], axis=1)
  logits_tm1 = networks.critic_logits(critic, critic_inputs[:, :-1], batch["action"][:, :-1])
  atoms = networks.atoms(config.network)
  flat = logits_tm1.shape[0] * (time - 1)
  loss = returns.categorical_critic_loss(
    logits_tm1.reshape(flat, -1),
    returns=steps.returns.reshape(flat),
    discounts=steps.discounts.reshape(flat),
    target_probabilities=bootstrap.reshape(flat, -1),
    atoms=atoms,
  )
  is_real = jnp.arange(time - 1) < batch["last"][:, None]
  is_known = (steps.bootstrap >= burn_in(batch)[:, None]) | (steps.discounts == 0)
  real = (is_real & is_known).astype(jnp.float32).reshape(flat)
  value = jax.nn.softmax(logits_tm1, axis=-1) @ atoms
  mean = losses.weighted_mean(loss, real)
  return mean, {
    "loss_critic": mean,
    "critic_value": losses.weighted_mean(value.reshape(flat), real),
    "reward": losses.weighted_mean(batch["reward"][:, :-1].reshape(flat), real),
  }


def _flatten_gaussian(gaussian: losses.Gaussian, flat: int) -> losses.Gaussian:
  return jax.tree.map(lambda x: x.reshape(flat, -1), gaussian)
