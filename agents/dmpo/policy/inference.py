"""The policy and the belief at one step, in NumPy alone: for actors, the evaluator and the robot.

Computes what `networks.py` computes, from the same parameters flattened to names such as
"policy/resnet/section0/conv/w" (a test compares the two). No JAX is imported: a policy starts at
once and needs neither compilation nor the learner's packages.

Shape letters: H, W picture, C channels, U embedding, M components of the belief.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nerf2real.agents.dmpo.config import NetworkConfig

Params = Mapping[str, Any]

_LAYER_NORM_EPSILON = 1e-5  # as in networks.py
_MIN_BELIEF_STDDEV = 0.01  # as in belief.py


class PolicyState(NamedTuple):
  """Output and cell of the LSTM [U]; of width 0 without one."""

  hidden: np.ndarray
  cell: np.ndarray


class PolicyStep(NamedTuple):
  """What the policy computes at one step."""

  mean: np.ndarray  # [A]
  stddev: np.ndarray  # [A]
  embedding: np.ndarray  # [U]
  state: PolicyState  # for the next step


def nest(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
  """Turns {"policy/mlp/layer0/w": array} into nested dictionaries."""
  tree: dict[str, Any] = {}
  for path, array in flat.items():
    *parents, name = path.split("/")
    node = tree
    for parent in parents:
      node = node.setdefault(parent, {})
    node[name] = array
  return tree


class Policy:
  """A policy with its parameters: `step` maps an observation to a Gaussian over actions."""

  def __init__(
    self, parameters: Mapping[str, np.ndarray], *, init_stddev: float, min_stddev: float
  ):
    """Creates a policy.

    Args:
      parameters: flat named arrays, `training_state.served_parameters`.
      init_stddev: the network's setting of that name.
      min_stddev: the network's setting of that name.
    """
    self._stddev_scale = np.float32(init_stddev / np.log(2.0))
    self._min_stddev = np.float32(min_stddev)
    self.update(parameters)

  @classmethod
  def of_network(cls, parameters: Mapping[str, np.ndarray], network: NetworkConfig) -> "Policy":
    """Creates the policy that runs a network's served parameters."""
    return cls(parameters, init_stddev=network.init_stddev, min_stddev=network.min_stddev)

  def update(self, parameters: Mapping[str, np.ndarray]) -> None:
    """Takes newer parameters of the same policy."""
    tree = nest(parameters)
    self._policy = tree["policy"]
    self._belief = tree.get("belief") or {}

  @property
  def lstm_size(self) -> int:
    """Units of the LSTM; 0 without one."""
    return self._policy["lstm"]["b"].shape[0] // 4 if "lstm" in self._policy else 0

  @property
  def has_belief(self) -> bool:
    """Whether the parameters hold a belief."""
    return bool(self._belief)

  def initial_state(self) -> PolicyState:
    """The LSTM's state at the start of an episode: zeros."""
    return PolicyState(np.zeros(self.lstm_size, np.float32), np.zeros(self.lstm_size, np.float32))

  def step(
    self, image: np.ndarray | None, proprioception: np.ndarray, state: PolicyState
  ) -> PolicyStep:
    """Computes the policy at one step.

    Args:
      image: picture uint8 [H, W, 3], or None.
      proprioception: flattened proprioception [S].
      state: the LSTM's state before this step.
    """
    embedding = np.zeros(0, np.float32)
    if image is not None:
      embedding = resnet(self._policy["resnet"], image)
      if "lstm" in self._policy:
        state = lstm_step(self._policy["lstm"], state, embedding)
        embedding = state.hidden
    hidden = mlp(self._policy["mlp"], np.concatenate([embedding, proprioception]))
    stddev = softplus(_linear(self._policy["stddev"], hidden)) * self._stddev_scale
    return PolicyStep(
      _linear(self._policy["mean"], hidden), stddev + self._min_stddev, embedding, state
    )

  def belief(self, embedding: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logits [M], means [M, 3] and deviations [M, 3] of the belief over x [m], y [m], yaw [rad]."""
    raw = _linear(self._belief["head"], mlp(self._belief["mlp"], embedding)).reshape(-1, 7)
    return raw[:, 0], raw[:, 1:4], softplus(raw[:, 4:]) + np.float32(_MIN_BELIEF_STDDEV)

  def believed_position(self, embedding: np.ndarray) -> np.ndarray:
    """Mean x, y [2] of the belief in metres."""
    logits, means, _ = self.belief(embedding)
    share = np.exp(logits - logits.max())
    return (share / share.sum()) @ means[:, :2]


def _linear(params: Params, x: np.ndarray) -> np.ndarray:
  return x @ params["w"] + params["b"]


def softplus(x: np.ndarray) -> np.ndarray:
  """log(1 + exp(x)), without overflow."""
  return np.logaddexp(x, np.float32(0))


def _sigmoid(x: np.ndarray) -> np.ndarray:
  return np.float32(0.5) * (np.tanh(np.float32(0.5) * x) + np.float32(1))


def mlp(params: Params, x: np.ndarray) -> np.ndarray:
  """Linear, layer norm, tanh, then linear and ELU for every further layer."""
  x = _linear(params["layer0"], x)
  x = x - x.mean()
  x = x / np.sqrt(np.mean(x * x) + np.float32(_LAYER_NORM_EPSILON))
  x = np.tanh(x * params["norm_scale"] + params["norm_bias"])
  layer = 1
  while f"layer{layer}" in params:
    x = _linear(params[f"layer{layer}"], x)
    x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    layer += 1
  return x


def _conv(params: Params, x: np.ndarray) -> np.ndarray:
  """3x3 convolution with zero borders: x [H, W, C] -> [H, W, outputs]."""
  height, width, channels = x.shape
  padded = np.zeros((height + 2, width + 2, channels), np.float32)
  padded[1:-1, 1:-1] = x
  patches = np.empty((height, width, 9 * channels), np.float32)
  for row in range(3):
    for column in range(3):
      begin = (3 * row + column) * channels
      patches[..., begin : begin + channels] = padded[row : row + height, column : column + width]
  weights = params["w"].reshape(9 * channels, -1)
  return (patches.reshape(height * width, -1) @ weights + params["b"]).reshape(height, width, -1)


def _halve(x: np.ndarray) -> np.ndarray:
  """Maximum over 3x3 windows at every second pixel; the border counts as minus infinity."""
  height, width, channels = x.shape
  padded = np.full((height + 2, width + 2, channels), -np.inf, np.float32)
  padded[1:-1, 1:-1] = x
  rows = np.maximum(np.maximum(padded[:-2:2], padded[1:-1:2]), padded[2::2])
  return np.maximum(np.maximum(rows[:, :-2:2], rows[:, 1:-1:2]), rows[:, 2::2])


def resnet(params: Params, image: np.ndarray) -> np.ndarray:
  """IMPALA's ResNet: a picture uint8 [H, W, 3] -> features."""
  x = image.astype(np.float32) / np.float32(255) - np.float32(0.5)
  index = 0
  while f"section{index}" in params:
    section = params[f"section{index}"]
    x = _halve(_conv(section["conv"], x))
    block = 0
    while f"block{block}_conv0" in section:
      y = _conv(section[f"block{block}_conv0"], np.maximum(x, 0))
      x = x + _conv(section[f"block{block}_conv1"], np.maximum(y, 0))
      block += 1
    index += 1
  return np.maximum(_linear(params["linear"], np.maximum(x, 0).ravel()), 0)


def lstm_step(params: Params, state: PolicyState, x: np.ndarray) -> PolicyState:
  """One step of the LSTM (gates i, g, f, o; forget bias 1)."""
  gates = np.concatenate([x, state.hidden]) @ params["w"] + params["b"]
  i, g, f, o = np.split(gates, 4)
  cell = _sigmoid(f + np.float32(1)) * state.cell + _sigmoid(i) * np.tanh(g)
  return PolicyState(_sigmoid(o) * np.tanh(cell), cell)
