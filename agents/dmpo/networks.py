"""The policy's and the critic's networks, as plain functions on dictionaries of arrays.

Policy (paper, "Policy training"): ResNet -> LSTM over the pictures; its output is joined with the
proprioception's history and goes through an MLP to a diagonal Gaussian. Critic: the same structure
with the simulation's state in place of the image encoder, and a categorical value (`num_atoms`).
`inference.py` computes the same policy with NumPy alone, from the same parameter names.

Shape letters: B batch, T time, H, W picture, S proprioception, P privileged, A action, U units of
the LSTM, K atoms. Matrices are [inputs, outputs]; convolution kernels [3, 3, inputs, outputs].
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from nerf2real.agents.dmpo.config import NetworkConfig
from nerf2real.agents.dmpo.losses import Gaussian
from nerf2real.agents.dmpo.specs import Layout

Params = dict[str, Any]

_LAYER_NORM_EPSILON = 1e-5


class LstmState(NamedTuple):
  """Output and cell of the LSTM [B, U]."""

  hidden: jax.Array
  cell: jax.Array


class PolicyOutput(NamedTuple):
  """What the policy computes for a trajectory."""

  action: Gaussian  # mean and stddev [B, T, A]
  embedding: jax.Array  # recurrent image embedding [B, T, U], of width 0 without pictures


# ---------------------------------------------------------------- initialisation


def _variance_scaled(key: jax.Array, shape: tuple[int, ...], scale: float, fan: int) -> jax.Array:
  limit = (3.0 * scale / fan) ** 0.5
  return jax.random.uniform(key, shape, jnp.float32, -limit, limit)


def init_linear(key: jax.Array, inputs: int, outputs: int, scale: float | None = None) -> Params:
  """Returns a linear layer's parameters.

  Weights are uniform with variance 1/3 of 1/outputs, a head's (`scale`) with scale * 1/inputs.
  Source: the reference implementation.
  """
  fan, scale = (outputs, 1.0 / 3.0) if scale is None else (inputs, scale)
  return {"w": _variance_scaled(key, (inputs, outputs), scale, fan), "b": jnp.zeros(outputs)}


def _init_conv(key: jax.Array, inputs: int, outputs: int) -> Params:
  weights = _variance_scaled(key, (3, 3, inputs, outputs), 1.0, 9 * inputs)  # LeCun
  return {"w": weights, "b": jnp.zeros(outputs)}


def init_mlp(key: jax.Array, inputs: int, widths: tuple[int, ...]) -> Params:
  """Returns the parameters of `mlp` for inputs of a size and layers of the widths."""
  keys = jax.random.split(key, len(widths))
  sizes = (inputs, *widths)
  layers = {f"layer{i}": init_linear(keys[i], sizes[i], sizes[i + 1]) for i in range(len(widths))}
  return layers | {"norm_scale": jnp.ones(widths[0]), "norm_bias": jnp.zeros(widths[0])}


def _init_resnet(key: jax.Array, config: NetworkConfig, image_shape: tuple[int, ...]) -> Params:
  params: Params = {}
  height, width, channels = image_shape
  for s, outputs in enumerate(config.image_channels):
    key, *keys = jax.random.split(key, 2 + 2 * config.image_blocks)
    section = {"conv": _init_conv(keys[0], channels, outputs)}
    for b in range(config.image_blocks):
      section[f"block{b}_conv0"] = _init_conv(keys[1 + 2 * b], outputs, outputs)
      section[f"block{b}_conv1"] = _init_conv(keys[2 + 2 * b], outputs, outputs)
    params[f"section{s}"] = section
    height, width, channels = -(-height // 2), -(-width // 2), outputs
  params["linear"] = init_linear(key, height * width * channels, config.image_features)
  return params


def _init_lstm(key: jax.Array, inputs: int, units: int) -> Params:
  weights = _variance_scaled(key, (inputs + units, 4 * units), 1.0, inputs + units)
  return {"w": weights, "b": jnp.zeros(4 * units)}


def embedding_size(config: NetworkConfig, layout: Layout) -> int:
  """Width of the image embedding that the MLP and the belief see; 0 without pictures."""
  if layout.image_shape is None:
    return 0
  return config.lstm_size if config.recurrent else config.image_features


def init_policy(key: jax.Array, config: NetworkConfig, layout: Layout) -> Params:
  """Returns the policy's parameters."""
  keys = jax.random.split(key, 5)
  params: Params = {}
  if layout.image_shape is not None:
    params["resnet"] = _init_resnet(keys[0], config, layout.image_shape)
    if config.recurrent:
      params["lstm"] = _init_lstm(keys[1], config.image_features, config.lstm_size)
  inputs = embedding_size(config, layout) + layout.state_size
  params["mlp"] = init_mlp(keys[2], inputs, config.policy_layers)
  last = config.policy_layers[-1]
  params["mean"] = init_linear(keys[3], last, layout.action_size, config.policy_head_scale)
  params["stddev"] = init_linear(keys[4], last, layout.action_size, config.policy_head_scale)
  return params


def init_critic(key: jax.Array, config: NetworkConfig, layout: Layout) -> Params:
  """Returns the critic's parameters."""
  keys = jax.random.split(key, 2)
  inputs = layout.state_size + layout.privileged_size + layout.action_size
  head = init_linear(keys[1], config.critic_layers[-1], config.num_atoms, config.critic_head_scale)
  return {"mlp": init_mlp(keys[0], inputs, config.critic_layers), "head": head}


# ---------------------------------------------------------------- application


def linear(params: Params, x: jax.Array) -> jax.Array:
  """x W + b: x [..., I] -> [..., O]."""
  return x @ params["w"] + params["b"]


def mlp(params: Params, x: jax.Array) -> jax.Array:
  """Linear, layer norm, tanh, then linear and ELU for every further layer."""
  return _after_first_layer(params, linear(params["layer0"], x))


def _after_first_layer(params: Params, x: jax.Array) -> jax.Array:
  x = x - x.mean(-1, keepdims=True)
  x = x * jax.lax.rsqrt(jnp.mean(x**2, -1, keepdims=True) + _LAYER_NORM_EPSILON)
  x = jnp.tanh(x * params["norm_scale"] + params["norm_bias"])
  for i in range(1, sum(name.startswith("layer") for name in params)):
    x = jax.nn.elu(linear(params[f"layer{i}"], x))
  return x


def _conv(params: Params, x: jax.Array) -> jax.Array:
  y = jax.lax.conv_general_dilated(
    x, params["w"], (1, 1), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
  )
  return y + params["b"]


def _halve(x: jax.Array) -> jax.Array:
  """Maximum over 3x3 windows at every second pixel; the border counts as minus infinity.

  Written as maxima of shifted slices: on a CPU the gradient of XLA's reduce_window takes 3.5 times
  as long (73 and 21 ms for 256 pictures [30, 40, 8] on one core).
  """
  for axis in (1, 2):
    count = -(-x.shape[axis] // 2)
    border = [(1, 1) if i == axis else (0, 0) for i in range(4)]
    padded = jnp.pad(x, border, constant_values=-jnp.inf)
    first, middle, final = (
      jax.lax.slice_in_dim(padded, start, start + 2 * count - 1, 2, axis) for start in range(3)
    )
    x = jnp.maximum(jnp.maximum(first, middle), final)
  return x


def resnet(params: Params, images: jax.Array, config: NetworkConfig) -> jax.Array:
  """IMPALA's ResNet: images in [0, 1] [N, H, W, 3] -> features [N, image_features]."""
  x = images - 0.5
  for s in range(len(config.image_channels)):
    section = params[f"section{s}"]
    x = _halve(_conv(section["conv"], x))
    for b in range(config.image_blocks):
      y = _conv(section[f"block{b}_conv0"], jax.nn.relu(x))
      x = x + _conv(section[f"block{b}_conv1"], jax.nn.relu(y))
  x = jax.nn.relu(x).reshape(x.shape[0], -1)
  return jax.nn.relu(linear(params["linear"], x))


def lstm_step(params: Params, state: LstmState, x: jax.Array) -> LstmState:
  """One step of an LSTM (gates i, g, f, o; forget bias 1): x [B, F] -> the next state [B, U]."""
  gates = jnp.concatenate([x, state.hidden], -1) @ params["w"] + params["b"]
  i, g, f, o = jnp.split(gates, 4, axis=-1)
  cell = jax.nn.sigmoid(f + 1.0) * state.cell + jax.nn.sigmoid(i) * jnp.tanh(g)
  return LstmState(jax.nn.sigmoid(o) * jnp.tanh(cell), cell)


def scan_lstm(
  params: Params, state: LstmState, x: jax.Array, burn_in: jax.Array | None = None
) -> tuple[LstmState, jax.Array]:
  """Runs the LSTM over inputs, time first [T, B, F]; returns its last state and outputs [T, B, U].

  Args:
    params: of the LSTM.
    state: before the first step [B, U].
    x: its inputs.
    burn_in: steps of each trajectory [B] beyond which no gradient flows back.
  """

  def step(state: LstmState, inputs: tuple[jax.Array, jax.Array]) -> tuple[LstmState, jax.Array]:
    x, time = inputs
    if burn_in is not None:
      cut = (time == burn_in)[:, None]
      state = jax.tree.map(lambda s: jnp.where(cut, jax.lax.stop_gradient(s), s), state)
    state = lstm_step(params, state, x)
    return state, state.hidden

  return jax.lax.scan(step, state, (x, jnp.arange(len(x))))


def unroll_lstm(
  params: Params, initial: LstmState, features: jax.Array, burn_in: jax.Array | None = None
) -> jax.Array:
  """Runs the LSTM over features [B, T, F] from a stored state; returns its outputs [B, T, U].

  See `scan_lstm`.
  """
  _, outputs = scan_lstm(params, initial, features.swapaxes(0, 1), burn_in)
  return outputs.swapaxes(0, 1)


def policy_head(
  params: Params, embedding: jax.Array, state: jax.Array, config: NetworkConfig
) -> Gaussian:
  """Embedding [..., U] and proprioception [..., S] -> the Gaussian over actions [..., A].

  sigma = softplus(W h + b) * init_stddev / softplus(0) + min_stddev; the mean is not squashed.
  """
  hidden = mlp(params["mlp"], jnp.concatenate([embedding, state], axis=-1))
  scale = config.init_stddev / jax.nn.softplus(0.0)
  stddev = jax.nn.softplus(linear(params["stddev"], hidden)) * scale + config.min_stddev
  return Gaussian(linear(params["mean"], hidden), stddev)


def unroll_policy(
  params: Params,
  config: NetworkConfig,
  *,
  state: jax.Array,
  images: jax.Array | None,
  initial: LstmState | None,
  features: jax.Array | None = None,
  embedding: jax.Array | None = None,
  burn_in: jax.Array | None = None,
) -> PolicyOutput:
  """Applies the policy to trajectories.

  Args:
    params: from `init_policy`.
    config: the network's settings.
    state: proprioception [B, T, S].
    images: pictures in [0, 1] [B, T, H, W, 3], or None.
    initial: the LSTM's state before the first step, as the actor stored it; None without an LSTM.
    features: of the pictures [B, T, F], in place of them; None where they are to be computed.
    embedding: output of the LSTM [B, T, U], in place of all that it is computed from; or None.
    burn_in: steps of each trajectory [B] that only unroll the LSTM; None for none.
  """
  if embedding is not None:
    return PolicyOutput(policy_head(params, embedding, state, config), embedding)
  batch, time = state.shape[:2]
  embedding = features
  if embedding is None and images is not None:
    flat = images.reshape(batch * time, *images.shape[2:])
    embedding = resnet(params["resnet"], flat, config).reshape(batch, time, -1)
  if embedding is None:
    embedding = jnp.zeros((batch, time, 0))
  elif "lstm" in params:
    if initial is None:
      raise ValueError("A recurrent policy needs the stored LSTM state, found None.")
    embedding = unroll_lstm(params["lstm"], initial, embedding, burn_in)
  return PolicyOutput(policy_head(params, embedding, state, config), embedding)


def critic_logits(params: Params, inputs: jax.Array, actions: jax.Array) -> jax.Array:
  """The critic's logits [..., K] for inputs [..., S + P] and actions [..., A], clipped to [-1, 1].

  Leading axes are broadcast against each other. The first layer's product with the inputs is taken
  once and not for every sampled action, W [x, a] = W_x x + W_a a.
  """
  first, count = params["mlp"]["layer0"], inputs.shape[-1]
  of_inputs = inputs @ first["w"][:count] + first["b"]
  of_actions = jnp.clip(actions, -1.0, 1.0) @ first["w"][count:]
  return linear(params["head"], _after_first_layer(params["mlp"], of_inputs + of_actions))


def atoms(config: NetworkConfig) -> jax.Array:
  """The support of the value distribution [K]."""
  return jnp.linspace(config.vmin, config.vmax, config.num_atoms)
