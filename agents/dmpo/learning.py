"""One update of the agent: the training state, and the jitted function that advances it.

Data flow: batch of trajectories -> augmentation, scaling -> policy and target policy over time ->
N actions of the target policy at every state -> the target critic's distributions -> n-step
categorical loss for the critic, MPO for the policy, likelihood for the belief -> Adam -> target
copies.

Shape letters: B trajectories, T time, N samples, A action, K atoms, E = B * T states.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerf2real.agents.dmpo import augmentation, belief, losses, networks, returns, scaling
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.inference import nest
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.specs import Layout, planar_pose

Metrics = dict[str, jax.Array]


class TrainingState(NamedTuple):
  """All that an update reads and writes."""

  policy: Params
  target_policy: Params
  critic: Params
  target_critic: Params
  duals: losses.DualParams
  belief: Params  # empty where the environment gives no pose or no pictures
  policy_optimiser: optax.OptState
  critic_optimiser: optax.OptState
  dual_optimiser: optax.OptState
  belief_optimiser: optax.OptState
  scaling: Params  # of the observations; empty without scaling
  steps: jax.Array  # [] int32, updates done
  key: jax.Array  # random key


class Learning(NamedTuple):
  """The pure functions of a learner."""

  init: Callable[[jax.Array], TrainingState]
  update: Callable[[TrainingState, Mapping[str, Any]], tuple[TrainingState, Metrics]]


def has_belief(layout: Layout) -> bool:
  """Whether a belief can be trained: needs pictures and the true pose."""
  return layout.image_shape is not None and layout.pose_columns is not None


def make_learning(
  config: DmpoConfig, layout: Layout, *, first_action: np.ndarray | None = None
) -> Learning:
  """Builds the learner's functions for an environment.

  Args:
    config: the agent's settings.
    layout: the environment's layout.
    first_action: what the policy's mean is about at the start [A]; zero if None.

  `update(state, batch)` takes a batch as `Replay.sample` gives it and is jitted; it gives the new
  state and metrics with fixed names. The state passed in must not be used again (donated).
  """
  optimisers = _make_optimisers(config)

  def init(key: jax.Array) -> TrainingState:
    key, policy_key, critic_key, belief_key = jax.random.split(key, 4)
    policy = networks.init_policy(policy_key, config.network, layout)
    if first_action is not None:
      policy["mean"]["b"] = jnp.asarray(first_action, jnp.float32)
    critic = networks.init_critic(critic_key, config.network, layout)
    duals = losses.init_duals(
      layout.action_size,
      log_temperature=config.init_log_temperature,
      log_alpha_mean=config.init_log_alpha_mean,
      log_alpha_stddev=config.init_log_alpha_stddev,
      per_dimension=config.per_dimension_kl,
    )
    embedding = networks.embedding_size(config.network, layout)
    beliefs: Params = {}
    if has_belief(layout):
      beliefs = belief.init_belief(belief_key, config.network, embedding)
    return TrainingState(
      policy=policy,
      target_policy=jax.tree.map(jnp.copy, policy),
      critic=critic,
      target_critic=jax.tree.map(jnp.copy, critic),
      duals=duals,
      belief=beliefs,
      policy_optimiser=optimisers["policy"].init(policy),
      critic_optimiser=optimisers["critic"].init(critic),
      dual_optimiser=optimisers["dual"].init(duals),
      belief_optimiser=optimisers["belief"].init(beliefs),
      scaling=jax.tree.map(jnp.asarray, scaling.identity(layout))
      if config.scale_observations
      else {},
      steps=jnp.zeros((), jnp.int32),
      key=key,
    )

  def update(state: TrainingState, batch: Mapping[str, Any]) -> tuple[TrainingState, Metrics]:
    key, loss_key = jax.random.split(state.key)
    trained = (state.policy, state.critic, state.duals, state.belief)
    gradients, metrics = jax.grad(total_loss, has_aux=True)(
      trained,
      state.target_policy,
      state.target_critic,
      batch=batch,
      key=loss_key,
      config=config,
      layout=layout,
      scales=state.scaling,
    )
    new, optimiser_states = [], []
    states = (
      state.policy_optimiser,
      state.critic_optimiser,
      state.dual_optimiser,
      state.belief_optimiser,
    )
    for name, grads, params, optimiser_state in zip(
      optimisers, gradients, trained, states, strict=True
    ):
      changes, optimiser_state = optimisers[name].update(grads, optimiser_state)
      new.append(optax.apply_updates(params, changes))
      optimiser_states.append(optimiser_state)
      if name in ("policy", "critic"):
        metrics[f"gradient_{name}"] = optax.global_norm(grads)
    policy, critic, duals, beliefs = new
    steps = state.steps + 1
    return TrainingState(
      policy=policy,
      target_policy=_copy_every(config.target_actor_period, steps, policy, state.target_policy),
      critic=critic,
      target_critic=_copy_every(config.target_critic_period, steps, critic, state.target_critic),
      duals=losses.clip_duals(duals),
      belief=beliefs,
      policy_optimiser=optimiser_states[0],
      critic_optimiser=optimiser_states[1],
      dual_optimiser=optimiser_states[2],
      belief_optimiser=optimiser_states[3],
      scaling=state.scaling,
      steps=steps,
      key=key,
    ), metrics

  return Learning(init, jax.jit(update, donate_argnums=0))


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

  Nothing follows a terminal state: the critic is never trained there, so that its values say
  nothing about actions. A state at which a trajectory was cut counts; another one goes on from it.

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


def served_parameters(state: TrainingState) -> dict[str, np.ndarray]:
  """What the actors need: the target policy and the belief, as flat named arrays.

  The policy takes observations as they are; the scaling folded into it goes along (`scaling/...`),
  so that training can begin with an exported policy.
  """
  policy = scaling.fold(state.target_policy, state.scaling)
  return flatten_params({"policy": policy, "belief": state.belief, "scaling": state.scaling})


def with_policy(state: TrainingState, parameters: Mapping[str, np.ndarray]) -> TrainingState:
  """Returns a fresh state whose policy and belief are those of an exported policy.

  The head of the standard deviation and all optimisers stay fresh. Where observations are scaled
  and the policy was exported without a scaling, its first layer is to be rewritten when one is
  measured (`with_scaling`).

  Args:
    state: a state that has seen no update.
    parameters: flat named arrays, `served_parameters`.

  Raises:
    ValueError: the arrays are not those of this network.
  """
  tree = nest(parameters)
  policy, beliefs, scales = tree["policy"], tree.get("belief", {}), state.scaling
  if scales and "scaling" in tree:
    scales = tree["scaling"]
    policy = scaling.unfold(policy, scales)
  policy = policy | {"stddev": state.policy["stddev"]}
  for name, given, wanted in (
    ("policy", policy, state.policy),
    ("belief", beliefs or state.belief, state.belief),
  ):
    found, expected = _shapes(given), _shapes(wanted)
    if found != expected:
      wrong = sorted(k for k in found | expected if found.get(k) != expected.get(k))
      raise ValueError(
        f"The {name} to begin with has other networks than the settings give: {wrong[0]} has the "
        f"shape {found.get(wrong[0])}, expected {expected.get(wrong[0])}. Take the preset and the "
        "--set of the run that made it."
      )
  arrays = jax.tree.map(jnp.array, {"policy": policy, "belief": beliefs or state.belief})
  return state._replace(
    policy=arrays["policy"],
    target_policy=jax.tree.map(jnp.copy, arrays["policy"]),
    belief=arrays["belief"],
    scaling=jax.tree.map(jnp.array, scales),
  )


def with_scaling(state: TrainingState, scales: Params, *, keep_policy: bool) -> TrainingState:
  """Returns a state that has seen no update with another scaling.

  Args:
    state: the state.
    scales: from `scaling.measure`.
    keep_policy: rewrites the policies' first layers so that they act as before; a policy with
      random weights is better left with them, for inputs of one size.
  """
  state = state._replace(scaling=jax.tree.map(jnp.array, scales))
  if not keep_policy:
    return state
  policy, target = (
    jax.tree.map(jnp.array, scaling.unfold(p, scales)) for p in (state.policy, state.target_policy)
  )
  return state._replace(policy=policy, target_policy=target)


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
  return {name: array.shape for name, array in flatten_params(params).items()}


def flatten_params(params: Params, prefix: str = "") -> dict[str, np.ndarray]:
  """Turns nested parameters into {"policy/mlp/layer0/w": array}."""
  flat: dict[str, np.ndarray] = {}
  for name, value in params.items():
    if isinstance(value, Mapping):
      flat |= flatten_params(dict(value), f"{prefix}{name}/")
    else:
      flat[f"{prefix}{name}"] = np.asarray(value)
  return flat


def _flatten_gaussian(gaussian: losses.Gaussian, flat: int) -> losses.Gaussian:
  return jax.tree.map(lambda x: x.reshape(flat, -1), gaussian)


def _copy_every(period: int, steps: jax.Array, online: Params, target: Params) -> Params:
  """A hard copy at every period-th update."""
  return jax.tree.map(lambda new, old: jnp.where(steps % period == 0, new, old), online, target)


def _make_optimisers(config: DmpoConfig) -> dict[str, optax.GradientTransformation]:
  """In the order of the trained parameters."""
  clip = optax.clip_by_global_norm(config.max_gradient_norm)
  return {
    "policy": optax.chain(clip, optax.adam(config.policy_learning_rate)),
    "critic": optax.chain(clip, optax.adam(config.critic_learning_rate)),
    "dual": optax.adam(config.dual_learning_rate),
    "belief": optax.adam(config.policy_learning_rate),
  }
