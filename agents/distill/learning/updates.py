"""The updates of a student: encoder, policy and walk on cached features, end to end; all jitted.

Shape letters: N pictures, B streams, T steps of an unroll, F features, U units of the LSTM, C
augmented copies.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerf2real.agents.distill.learning import losses, student
from nerf2real.agents.distill.settings import DistillSettings
from nerf2real.agents.dmpo import augmentation, belief, scaling
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.specs import Layout

Metrics = dict[str, jax.Array]
# Frames of one augmentation where features are cached: some 0.8 s, as in an unroll.
_SEGMENT = 32


class TrainingState(NamedTuple):
  """All that updates read and write."""

  student: dict[str, Params]
  encoder_optimiser: Any
  policy_optimiser: Any
  joint_optimiser: Any  # end to end
  scales: Params  # standardisation of the proprioception, `dmpo.scaling`
  spread: jax.Array  # of the teacher's actions [A]
  key: jax.Array


class Updates(NamedTuple):
  """The pure functions of a learner."""

  init: Callable[[jax.Array], TrainingState]
  encoder: Callable[..., tuple[TrainingState, Metrics]]
  policy: Callable[..., tuple[TrainingState, LstmState, Metrics]]
  walk: Callable[..., tuple[TrainingState, LstmState, Metrics]]
  end_to_end: Callable[..., tuple[TrainingState, LstmState, Metrics]]
  features: Callable[..., jax.Array]
  inner: Callable[..., student.StudentOutput]
  predict: Callable[..., Metrics]


def make_updates(settings: DistillSettings, layout: Layout) -> Updates:
  """Builds the updates.

  Args:
    settings: of the distillation.
    layout: the environment's layout.

  `encoder(state, batch, rate)` takes single frames of `image`, `pose` and, where there is a ball,
  `ball`; `policy(state, batch, carried, rate)`, `walk(...)` and
  `end_to_end(...)` take unrolls of `state`, `label`, `command`, `pose`, `goal_distance`, `begins`
  and of `features` or `image`, and the LSTM's state before them. Training states are donated.
  """
  config = settings.agent
  optimiser = optax.chain(
    optax.clip_by_global_norm(settings.max_gradient_norm), optax.scale_by_adam()
  )

  def init(key: jax.Array) -> TrainingState:
    key, first = jax.random.split(key)
    params = student.init_student(first, config.network, layout)
    return TrainingState(
      student=params,
      encoder_optimiser=optimiser.init(params["encoder"]),
      policy_optimiser=optimiser.init(_without_encoder(params)),
      joint_optimiser=optimiser.init(params),
      scales=jax.tree.map(jnp.asarray, {"state": scaling.identity(layout)["state"]}),
      spread=jnp.ones(layout.action_size),
      key=key,
    )

  def step(params: Any, gradients: Any, optimiser_state: Any, rate: jax.Array) -> tuple[Any, Any]:
    changes, optimiser_state = optimiser.update(gradients, optimiser_state)
    changes = jax.tree.map(lambda change: -rate * change, changes)
    return optax.apply_updates(params, changes), optimiser_state

  def encoder(
    state: TrainingState, batch: Mapping[str, jax.Array], rate: jax.Array
  ) -> tuple[TrainingState, Metrics]:
    key, augment_key = jax.random.split(state.key)

    def loss(params: Params) -> tuple[jax.Array, Metrics]:
      images = augmentation.augment(
        augment_key, _scaled(batch["image"])[:, None], config.augmentation
      )
      features = student.encode(params, images[:, 0], config.network)
      pose = losses.camera_pose(batch["pose"], batch.get("ball"))
      value = losses.pose_loss(student.predict_pose(params, features), pose)
      metrics = {"loss_encoder": value}
      if "ball" in batch:
        target, seen = losses.ball_target_of_picture(batch["ball"])
        metrics["loss_ball"] = losses.ball_loss(
          student.predict_ball(params, features), target, seen
        )
        value = value + metrics["loss_ball"]
      return value, metrics

    params = state.student["encoder"]
    gradients, metrics = jax.grad(loss, has_aux=True)(params)
    params, optimiser_state = step(params, gradients, state.encoder_optimiser, rate)
    return state._replace(
      student=state.student | {"encoder": params}, encoder_optimiser=optimiser_state, key=key
    ), metrics

  def policy(
    state: TrainingState,
    batch: Mapping[str, jax.Array],
    carried: LstmState,
    rate: jax.Array,
    *,
    keeps_memory: bool = False,
  ) -> tuple[TrainingState, LstmState, Metrics]:
    def loss(params: dict[str, Params]):
      if keeps_memory:
        params = _with_memory(params, jax.lax.stop_gradient(params))
      return unroll_loss(params, state, batch, batch["features"], carried, settings)

    params = _without_encoder(state.student)
    gradients, (carried, metrics) = jax.grad(loss, has_aux=True)(params)
    params, optimiser_state = step(params, gradients, state.policy_optimiser, rate)
    if keeps_memory:  # what the optimiser remembers of an earlier stage would move it on
      params = _with_memory(params, state.student)
    new = state._replace(student=state.student | params, policy_optimiser=optimiser_state)
    return new, carried, metrics

  def end_to_end(
    state: TrainingState, batch: Mapping[str, jax.Array], carried: LstmState, rate: jax.Array
  ) -> tuple[TrainingState, LstmState, Metrics]:
    key, augment_key = jax.random.split(state.key)
    images = augmentation.augment(augment_key, _scaled(batch["image"]), config.augmentation)
    size, time = images.shape[:2]

    def loss(params: dict[str, Params]):
      flat = images.reshape(size * time, *images.shape[2:])
      features = student.encode(params["encoder"], flat, config.network).reshape(size, time, -1)
      return unroll_loss(params, state, batch, features, carried, settings)

    gradients, (carried, metrics) = jax.grad(loss, has_aux=True)(state.student)
    params, optimiser_state = step(state.student, gradients, state.joint_optimiser, rate)
    return (
      state._replace(student=params, joint_optimiser=optimiser_state, key=key),
      carried,
      metrics,
    )

  def features(params: Params, images: jax.Array, key: jax.Array | None) -> jax.Array:
    """Features [N, F] of pictures uint8 [N, H, W, 3], N a multiple of 32; augmented with a key."""
    x = _scaled(images)
    if key is not None:
      segments = x.reshape(-1, _SEGMENT, *x.shape[1:])
      x = augmentation.augment(key, segments, config.augmentation).reshape(x.shape)
    return student.encode(params, x, config.network).astype(jnp.float16)

  def inner(state: TrainingState, batch: Mapping[str, jax.Array]) -> student.StudentOutput:
    """All that a student computes for whole episodes [B, T]."""
    return student.unroll(
      state.student["policy"],
      features=batch["features"],
      state=scaling.apply(state.scales, "state", batch["state"]),
      begins=batch["begins"],
      initial=student.initial_state(batch["state"].shape[0], config.network),
    )

  def predict(state: TrainingState, batch: Mapping[str, jax.Array]) -> Metrics:
    """Pose errors and action error of whole episodes [B, T], by frame."""
    single = student.predict_pose(state.student["encoder"], batch["features"])
    found = inner(state, batch)
    result = {"action_error": jnp.mean(jnp.abs(found.action - batch["label"]), axis=-1)}
    pose = losses.camera_pose(batch["pose"], batch.get("ball"))
    for name, predicted in (("picture", single), ("recurrent", found.pose)):
      distance, turn = losses.pose_errors(predicted, pose)
      result |= {f"{name}_distance": distance, f"{name}_turn": turn}
    return result

  return Updates(
    init=init,
    encoder=jax.jit(encoder, donate_argnums=0),
    policy=jax.jit(policy, donate_argnums=0),
    walk=jax.jit(functools.partial(policy, keeps_memory=True), donate_argnums=0),
    end_to_end=jax.jit(end_to_end, donate_argnums=0),
    features=jax.jit(features),
    inner=jax.jit(inner),
    predict=jax.jit(predict),
  )


def standardised(
  state: TrainingState,
  *,
  state_rows: np.ndarray,
  labels: np.ndarray,
  layout: Layout,
  min_spread: float,
  keep_policy: bool = False,
) -> TrainingState:
  """Returns a state that has seen no update, with the inputs' and actions' scales of first data.

  Its student does what the teacher does on average, or with `keep_policy` what it did before.

  Args:
    state: the state.
    state_rows: proprioception [N, S].
    labels: the teacher's actions [N, A].
    layout: the environment's layout.
    min_spread: smallest spread of an action.
    keep_policy: rewrites the first layer for standardised inputs in place of the last one's bias.
  """
  public = dataclasses.replace(layout, privileged_names=(), privileged_sizes=())
  scales = scaling.measure({"state": state_rows}, public)
  policy = state.student["policy"]
  if keep_policy:
    policy = jax.tree.map(jnp.asarray, scaling.unfold(policy, scales))
  else:
    policy = policy | {"mean": policy["mean"] | {"b": jnp.asarray(labels.mean(0))}}
  return state._replace(
    student=state.student | {"policy": policy},
    scales=jax.tree.map(jnp.asarray, scales),
    spread=jnp.asarray(np.maximum(labels.std(0), min_spread)),
  )


def unroll_loss(
  params: dict[str, Params],
  state: TrainingState,
  batch: Mapping[str, jax.Array],
  features: jax.Array,
  carried: LstmState,
  settings: DistillSettings,
) -> tuple[jax.Array, tuple[LstmState, Metrics]]:
  """Sum of the losses of actions, pose, command and belief over unrolls.

  Args:
    params: the student's "policy" and "belief".
    state: for standardisation and spread.
    batch: see `make_updates`.
    features: of the pictures [B, T, F].
    carried: the LSTM's state before them.
    settings: of the distillation.
  """
  found = student.unroll(
    params["policy"],
    features=features.astype(jnp.float32),
    state=scaling.apply(state.scales, "state", batch["state"]),
    begins=batch["begins"],
    initial=carried,
  )
  weights = losses.frame_weights(
    batch["command"],
    batch["goal_distance"],
    turn_emphasis=settings.turn_emphasis,
    blind_radius=settings.blind_radius,
  )
  embedding = found.embedding.reshape(-1, found.embedding.shape[-1])
  pose = losses.camera_pose(batch["pose"], batch.get("ball"))
  likelihood = belief.log_likelihood(
    belief.predict(params["belief"], embedding), pose.reshape(-1, 3)
  )
  metrics = {
    "loss_action": losses.action_loss(
      found.action, batch["label"], spread=state.spread, weights=weights
    ),
    "loss_pose": losses.pose_loss(found.pose, pose),
    "loss_command": losses.command_loss(found.command, batch["command"], weights),
    "loss_belief": -jnp.mean(likelihood),
  }
  loss = (
    metrics["loss_action"]
    + settings.pose_weight * metrics["loss_pose"]
    + settings.command_weight * metrics["loss_command"]
    + settings.belief_weight * metrics["loss_belief"]
  )
  if found.ball is not None:
    metrics["loss_ball"] = losses.ball_loss(
      found.ball, losses.ball_target(batch["ball"]), jnp.ones_like(batch["goal_distance"])
    )
    loss = loss + settings.ball_weight * metrics["loss_ball"]
  return loss, (found.state, metrics)


def _without_encoder(params: dict[str, Params]) -> dict[str, Params]:
  return {name: params[name] for name in ("policy", "belief")}


def _with_memory(params: dict[str, Params], other: dict[str, Params]) -> dict[str, Params]:
  """Returns parameters with the LSTM and the belief of others."""
  policy = params["policy"] | {"lstm": other["policy"]["lstm"]}
  return {"policy": policy, "belief": other["belief"]}


def _scaled(images: jax.Array) -> jax.Array:
  return images.astype(jnp.float32) / 255.0
