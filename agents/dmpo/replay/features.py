"""Features of a frozen image encoder, computed once for every picture and stored in its place.

An update then spends no time on convolutions. Where the LSTM is frozen, too, its outputs are
stored, and an update spends none on unrolls either. The pictures are augmented when they are
encoded, so that several copies are stored; one draw of the augmentation serves a whole trajectory,
as in `augmentation`.

Shape letters: T observations of a trajectory, C copies, F features, U units of the LSTM.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.dmpo import networks
from nerf2real.agents.dmpo.augmentation import augment
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import LstmState, Params
from nerf2real.agents.dmpo.replay.ring import Field

_MEMORY = ("lstm_hidden", "lstm_cell")  # of a trajectory


def stored_fields(of_actors: Mapping[str, Field], config: DmpoConfig) -> dict[str, Field]:
  """Shapes and types of what a replay holds, from those of what actors send."""
  if not config.frozen_encoder:
    return dict(of_actors)
  network, replaced = config.network, _replaced(config)
  width = network.lstm_size if config.frozen_memory else network.image_features
  kept = {name: field for name, field in of_actors.items() if name not in replaced}
  return kept | {_name(config): Field((config.feature_copies, width), "float16")}


def _name(config: DmpoConfig) -> str:
  return "embedding" if config.frozen_memory else "features"


def _replaced(config: DmpoConfig) -> tuple[str, ...]:
  return ("image", *_MEMORY) if config.frozen_memory else ("image",)


class FrozenEncoder:
  """Maps pictures to features, or to the outputs of a frozen LSTM behind them.

  It keeps parameters of its own, which no update moves or donates.
  """

  def __init__(self, policy: Params, config: DmpoConfig, *, length: int, seed: int):
    """Compiles the encoder.

    Args:
      policy: parameters of the policy.
      config: the agent's settings.
      length: most observations that are encoded at once, T.
      seed: of the augmentation.
    """
    self.has_memory = config.frozen_memory
    self.name = _name(config)
    frozen = ("resnet", "lstm") if self.has_memory else ("resnet",)
    self._params = jax.tree.map(jnp.array, jax.device_get({n: policy[n] for n in frozen}))
    self._length, self._config = length, config
    self._rng = np.random.default_rng((seed, 5))

    def encode(
      params: Params, images: jax.Array, key: jax.Array, state: LstmState
    ) -> tuple[jax.Array, LstmState]:
      copies = jnp.repeat(images[None].astype(jnp.float32) / 255.0, config.feature_copies, axis=0)
      changed = augment(key, copies[1:], config.augmentation)  # the first one is as it is
      flat = jnp.concatenate([copies[:1], changed]).reshape(-1, *images.shape[1:])
      features = networks.resnet(params["resnet"], flat, config.network)
      made = features.reshape(config.feature_copies, length, -1).swapaxes(0, 1)  # [T, C, F]
      if "lstm" in params:
        state, made = networks.scan_lstm(params["lstm"], state, made)
      return made.astype(jnp.float16), state

    self._encode = jax.jit(encode)

  def encode(
    self, images: np.ndarray, initial: tuple[np.ndarray, np.ndarray] | None = None
  ) -> np.ndarray:
    """Returns features [N, C, F], or outputs of the LSTM [N, C, U], of consecutive pictures.

    Args:
      images: uint8 [N, H, W, 3]; every T of them share a draw of the augmentation.
      initial: the LSTM's output and cell before the first one [U]; None for zeros.
    """
    shape = (self._config.feature_copies, self._config.network.lstm_size)
    hidden, cell = initial or (np.zeros(shape[1:], np.float32),) * 2
    state = LstmState(*(jnp.broadcast_to(jnp.asarray(part), shape) for part in (hidden, cell)))
    parts = []
    for begin in range(0, len(images), self._length):
      chunk = images[begin : begin + self._length]
      padded = np.zeros((self._length, *images.shape[1:]), np.uint8)
      padded[: len(chunk)] = chunk
      key = jax.random.PRNGKey(int(self._rng.integers(2**31)))
      made, state = self._encode(self._params, padded, key, state)
      parts.append(np.asarray(made)[: len(chunk)])
    return np.concatenate(parts)

  def replace(self, trajectory: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns a trajectory with what was made of its pictures in place of them."""
    replaced = _replaced(self._config)
    others: dict[str, Any] = {n: a for n, a in trajectory.items() if n not in replaced}
    hidden, cell = _MEMORY
    initial = (trajectory[hidden], trajectory[cell]) if self.has_memory else None
    return others | {self.name: self.encode(trajectory["image"], initial)}
