"""The student: the agent's policy and belief networks, with heads that only training has.

Data flow: pictures -> ResNet -> LSTM -> embedding; embedding and proprioception -> MLP -> action.
On the way three heads are supervised: the pose from one picture's features (encoder stage), the
pose from the embedding, and the teacher's command from the MLP's last layer; where there is a ball,
two more: its place from one picture, and from the MLP's last layer. The belief is the
agent's own and is exported.

Shape letters: B streams, T steps, N pictures, F features, U embedding, S proprioception,
M units of the MLP's last layer.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.distill.teacher import COMMAND_SIZE
from nerf2real.agents.dmpo import belief, networks, scaling, training_state
from nerf2real.agents.dmpo.config import NetworkConfig
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.specs import BALL, Layout

_POSE_TARGETS = 4  # see losses.pose_target
_BALL_TARGETS = 2  # see losses.ball_target
_HEAD_SCALE = 0.1  # variance scale of the first weights; chosen


class StudentOutput(NamedTuple):
  """What a student computes for unrolls."""

  action: jax.Array  # mean [B, T, A]
  pose: jax.Array  # target of the pose [B, T, 4]
  command: jax.Array  # [B, T, 2]
  ball: jax.Array | None  # target of the ball [B, T, 2], where there is one
  embedding: jax.Array  # [B, T, U]
  hidden: jax.Array  # the MLP's last layer [B, T, M]
  state: LstmState  # after the last step [B, U]


def init_student(key: jax.Array, config: NetworkConfig, layout: Layout) -> dict[str, Params]:
  """Returns {"encoder", "policy", "belief"}: "encoder" is the ResNet with its pose head."""
  keys = jax.random.split(key, 5)
  has_ball = layout.privileged_column(BALL) is not None
  policy = networks.init_policy(keys[0], config, layout)
  if "lstm" not in policy:
    raise ValueError("A student needs pictures and an LSTM: network.recurrent must be true.")

  def head(key: jax.Array, inputs: int, outputs: int) -> Params:
    return networks.init_linear(key, inputs, outputs, _HEAD_SCALE)

  encoder = {
    "resnet": policy.pop("resnet"),
    "pose": head(keys[1], config.image_features, _POSE_TARGETS),
  }
  policy["mean"] = head(keys[2], config.policy_layers[-1], layout.action_size)
  heads = {
    "pose": head(keys[3], config.lstm_size, _POSE_TARGETS),
    "command": head(keys[4], config.policy_layers[-1], COMMAND_SIZE),
  }
  if has_ball:
    encoder["ball"] = head(jax.random.fold_in(key, 1), config.image_features, _BALL_TARGETS)
    heads["ball"] = head(jax.random.fold_in(key, 2), config.policy_layers[-1], _BALL_TARGETS)
  beliefs = belief.init_belief(keys[3], config, config.lstm_size)
  return {"encoder": encoder, "policy": policy | {"heads": heads}, "belief": beliefs}


def encode(encoder: Params, images: jax.Array, config: NetworkConfig) -> jax.Array:
  """Maps pictures in [0, 1] [N, H, W, 3] to features [N, F]."""
  return networks.resnet(encoder["resnet"], images, config)


def predict_pose(encoder: Params, features: jax.Array) -> jax.Array:
  """Maps features [..., F] to pose targets [..., 4]."""
  return networks.linear(encoder["pose"], features)


def predict_ball(encoder: Params, features: jax.Array) -> jax.Array:
  """Maps features [..., F] to the ball's targets as seen from the head [..., 2]."""
  return networks.linear(encoder["ball"], features)


def unroll(
  policy: Params,
  *,
  features: jax.Array,
  state: jax.Array,
  begins: jax.Array,
  initial: LstmState,
) -> StudentOutput:
  """Applies LSTM, MLP and heads to unrolls.

  Args:
    policy: the student's "policy".
    features: of the pictures [B, T, F].
    state: standardised proprioception [B, T, S].
    begins: 1 where an episode begins [B, T]: the LSTM's state is zeroed before that step.
    initial: the LSTM's state before the first step [B, U].
  """

  def step(carried: LstmState, inputs: tuple[jax.Array, jax.Array]) -> tuple[LstmState, jax.Array]:
    x, begin = inputs
    keep = 1.0 - begin[:, None]
    carried = LstmState(carried.hidden * keep, carried.cell * keep)
    carried = networks.lstm_step(policy["lstm"], carried, x)
    return carried, carried.hidden

  last, outputs = jax.lax.scan(step, initial, (features.swapaxes(0, 1), begins.swapaxes(0, 1)))
  embedding = outputs.swapaxes(0, 1)
  hidden = networks.mlp(policy["mlp"], jnp.concatenate([embedding, state], axis=-1))
  return StudentOutput(
    action=networks.linear(policy["mean"], hidden),
    pose=networks.linear(policy["heads"]["pose"], embedding),
    command=networks.linear(policy["heads"]["command"], hidden),
    ball=networks.linear(policy["heads"]["ball"], hidden) if "ball" in policy["heads"] else None,
    embedding=embedding,
    hidden=hidden,
    state=last,
  )


def initial_state(count: int, config: NetworkConfig) -> LstmState:
  """The LSTM's state of `count` streams at an episode's start: zeros [B, U]."""
  zeros = jnp.zeros((count, config.lstm_size))
  return LstmState(zeros, zeros)


def served_parameters(student: dict[str, Params], scales: Params) -> dict[str, np.ndarray]:
  """Flat named arrays of the policy and the belief, for observations as they are.

  The standardisation is folded into the first layer, the training's heads are left out, and the
  deviation's weights are zero, so that it is `init_stddev` everywhere.
  """
  policy: dict[str, Any] = {
    name: params for name, params in student["policy"].items() if name != "heads"
  }
  policy["resnet"] = student["encoder"]["resnet"]
  policy["stddev"] = jax.tree.map(np.zeros_like, jax.device_get(policy["stddev"]))
  policy = scaling.fold(jax.device_get(policy), scales)
  flat = training_state.flatten_params({"policy": policy, "belief": student["belief"]})
  return {name: np.asarray(array, np.float32) for name, array in flat.items()}
