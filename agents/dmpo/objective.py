"""The agent's objective: MPO for the policy, a categorical critic, likelihood for the belief.

Data flow: batch of trajectories -> augmentation, scaling -> policy and target policy over time ->
N actions of the target policy at every state -> the target critic's distributions -> n-step
categorical loss for the critic, MPO for the policy, likelihood for the belief.

Shape letters: B trajectories, T time, N samples, A action, K atoms, E = B * T states.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo import augmentation, belief, losses, networks, returns, scaling
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.specs import Layout, planar_pose

Metrics = dict[str, jax.Array]


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
) -> tuple[jax.Array, Metrics]:
  """Sum of the losses of policy, duals, critic and belief; each reaches its own parameters only.

  Args:
    trained: parameters of policy, critic, duals and belief.
    target_policy: parameters of the target policy.
    target_critic: parameters of the target critic.
    batch: `state` [B, T, S], `privileged` [B, T, P], `action` [B, T, A], `reward` and `discount`
      [B, T], `last` [B]; `image` uint8 [B, T, H, W, 3], `lstm_hidden` and `lstm_cell` [B, U].
    key: random key.
    config: the agent's settings.
    layout: the environment's layout.
    scales: of the observations, from `scaling`; none if empty.
  """
  policy, critic, duals, beliefs = trained
  augment_key, sample_key = jax.random.split(key)
  state = scaling.apply(scales or {}, "state", batch["state"])
  privileged = scaling.apply(scales or {}, "privileged", batch["privileged"])
  last = batch["last"]
  size, time = state.shape[:2]
  images = None
  if "image" in batch:
    images = batch["image"].astype(jnp.float32) / 255.0
    images = augmentation.augment(augment_key, images, config.augmentation)
  initial = None
  if "lstm_hidden" in batch:
    initial = LstmState(batch["lstm_hidden"], batch["lstm_cell"])
  inputs = {"state": state, "images": images, "initial": initial}
  online = networks.unroll_policy(policy, config.network, **inputs)
  target = networks.unroll_policy(target_policy, config.network, **inputs)
  target = jax.lax.stop_gradient(target)

  # One set of sampled actions serves the E-step and the bootstrap.
  noise = jax.random.normal(sample_key, (config.num_samples, *target.action.mean.shape))
  actions = target.action.mean + target.action.stddev * noise  # [N, B, T, A]
  critic_inputs = jnp.concatenate([state, privileged], axis=-1)
  atoms = networks.atoms(config.network)
  probabilities = jax.nn.softmax(
    networks.critic_logits(target_critic, critic_inputs, actions), axis=-1
  )  # [N, B, T, K]
  values = jax.lax.stop_gradient(probabilities @ atoms)  # [N, B, T]

  loss_critic, metrics = critic_loss(
    critic,
    critic_inputs=critic_inputs,
    batch=batch,
    target_probabilities=jax.lax.stop_gradient(probabilities.mean(0)),
    config=config,
  )

  flat = size * time
  present = (jnp.arange(time) <= last[:, None]).astype(jnp.float32)  # [B, T], 0 for padding
  loss_mpo, mpo_metrics = losses.mpo_loss(
    duals,
    _flatten_gaussian(online.action, flat),
    target=_flatten_gaussian(target.action, flat),
    actions=actions.reshape(config.num_samples, flat, -1),
    values=values.reshape(config.num_samples, flat),
    weights=policy_weights(batch["discount"], last).reshape(flat),
    epsilons=losses.MpoEpsilons(
      config.epsilon, config.epsilon_mean, config.epsilon_stddev, config.epsilon_action_penalty
    ),
    action_penalization=config.action_penalization,
  )
  metrics |= mpo_metrics
  loss = loss_critic + loss_mpo
  if beliefs:
    assert layout.pose_columns is not None
    embedding = online.embedding.reshape(flat, -1)
    pose = planar_pose(batch["privileged"], layout.pose_columns, jnp).reshape(flat, 3)
    predicted = belief.predict(beliefs, embedding)
    likelihood = belief.log_likelihood(predicted, pose)
    loss_belief = -losses.weighted_mean(likelihood, present.reshape(flat))
    loss = loss + loss_belief
    metrics["loss_belief"] = loss_belief
    metrics["belief_error"] = losses.weighted_mean(
      belief.localisation_error(predicted, pose), present.reshape(flat)
    )
  metrics["loss"] = loss
  return loss, metrics


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

  Args:
    critic: parameters that learn.
    critic_inputs: what the critic sees [B, T, S + P].
    batch: `action` [B, T, A], `reward` and `discount` [B, T], `last` [B].
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
  real = (jnp.arange(time - 1) < batch["last"][:, None]).astype(jnp.float32).reshape(flat)
  value = jax.nn.softmax(logits_tm1, axis=-1) @ atoms
  mean = losses.weighted_mean(loss, real)
  return mean, {
    "loss_critic": mean,
    "critic_value": losses.weighted_mean(value.reshape(flat), real),
    "reward": losses.weighted_mean(batch["reward"][:, :-1].reshape(flat), real),
  }


def _flatten_gaussian(gaussian: losses.Gaussian, flat: int) -> losses.Gaussian:
  return jax.tree.map(lambda x: x.reshape(flat, -1), gaussian)
