"""One update of the agent: gradients of the objective -> Adam -> copies to the target networks."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerf2real.agents.dmpo import belief, losses, networks, scaling
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import Params
from nerf2real.agents.dmpo.objective import Metrics, critic_objective, total_loss
from nerf2real.agents.dmpo.specs import Layout
from nerf2real.agents.dmpo.training_state import TrainingState


class Learning(NamedTuple):
  """The pure functions of a learner."""

  init: Callable[[jax.Array], TrainingState]
  update: Callable[[TrainingState, Mapping[str, Any]], tuple[TrainingState, Metrics]]
  update_critic: Callable[[TrainingState, Mapping[str, Any]], tuple[TrainingState, Metrics]]


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
  state and metrics with fixed names. `update_critic` does so for the critic alone. The state passed
  in must not be used again (donated).
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
      student=jax.tree.map(jnp.copy, policy) if config.student_kl else {},
    )

  def update_critic(
    state: TrainingState, batch: Mapping[str, Any]
  ) -> tuple[TrainingState, Metrics]:
    key, loss_key = jax.random.split(state.key)
    gradients, metrics = jax.grad(critic_objective, has_aux=True)(
      state.critic,
      state.target_policy,
      state.target_critic,
      batch=batch,
      key=loss_key,
      config=config,
      scales=state.scaling,
    )
    changes, optimiser_state = optimisers["critic"].update(gradients, state.critic_optimiser)
    critic, steps = optax.apply_updates(state.critic, changes), state.steps + 1
    metrics["gradient_critic"] = optax.global_norm(gradients)
    return state._replace(
      critic=critic,
      target_critic=_copy_every(config.target_critic_period, steps, critic, state.target_critic),
      critic_optimiser=optimiser_state,
      steps=steps,
      key=key,
    ), metrics

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
      student=state.student,
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
    return state._replace(
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
      steps=steps,
      key=key,
    ), metrics

  return Learning(init, jax.jit(update, donate_argnums=0), jax.jit(update_critic, donate_argnums=0))


def student_weight(config: DmpoConfig, updates: int, mean_return: float | None) -> float:
  """Weight of the KL from the policy that a run began with.

  w = student_kl * (1 - share of the updates) * (1 - share of the way between the returns).

  Args:
    config: the agent's settings.
    updates: done so far.
    mean_return: of the last acting episodes; None while there are none.
  """
  weight = config.student_kl
  if config.student_kl_updates:
    done = max(0, updates - config.critic_warmup) / config.student_kl_updates
    weight *= max(0.0, 1.0 - done)
  if config.student_kl_returns is not None and mean_return is not None:
    low, high = config.student_kl_returns
    weight *= float(np.clip((high - mean_return) / (high - low), 0.0, 1.0))
  return weight


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
