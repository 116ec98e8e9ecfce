"""Features of a frozen image encoder, computed once for every picture and stored in its place.

An update then spends no time on convolutions. The pictures are augmented when they are encoded, so
that several copies are stored; one draw of the augmentation serves a whole trajectory, as in
`augmentation`.

Shape letters: T observations of a trajectory, C copies, F features.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.dmpo import networks
from nerf2real.agents.dmpo.augmentation import augment
from nerf2real.agents.dmpo.config import DmpoConfig
from nerf2real.agents.dmpo.networks import Params
from nerf2real.agents.dmpo.replay.ring import Field


class FrozenEncoder:
  """Maps pictures to features; keeps parameters of its own, which no update moves or donates."""

  def __init__(self, policy: Params, config: DmpoConfig, *, length: int, seed: int):
    """Compiles the encoder.

    Args:
      policy: parameters of the policy.
      config: the agent's settings.
      length: most observations that are encoded at once, T.
      seed: of the augmentation.
    """
    self._params = jax.tree.map(jnp.array, jax.device_get(policy["resnet"]))
    self._length, self._config = length, config
    self._rng = np.random.default_rng((seed, 5))

    def encode(params: Params, images: jax.Array, key: jax.Array) -> jax.Array:
      copies = jnp.repeat(images[None].astype(jnp.float32) / 255.0, config.feature_copies, axis=0)
      changed = augment(key, copies[1:], config.augmentation)  # the first one is as it is
      flat = jnp.concatenate([copies[:1], changed]).reshape(-1, *images.shape[1:])
      features = networks.resnet(params, flat, config.network)
      return features.reshape(config.feature_copies, length, -1).swapaxes(0, 1).astype(jnp.float16)

    self._encode = jax.jit(encode)

  def field(self) -> Field:
    """Shape and type of a step's features in a replay."""
    return Field((self._config.feature_copies, self._config.network.image_features), "float16")

  def encode(self, images: np.ndarray) -> np.ndarray:
    """Returns features [N, C, F] of pictures uint8 [N, H, W, 3]; every T of them share a draw."""
    parts = []
    for begin in range(0, len(images), self._length):
      chunk = images[begin : begin + self._length]
      padded = np.zeros((self._length, *images.shape[1:]), np.uint8)
      padded[: len(chunk)] = chunk
      key = jax.random.PRNGKey(int(self._rng.integers(2**31)))
      parts.append(np.asarray(self._encode(self._params, padded, key))[: len(chunk)])
    return np.concatenate(parts)

  def replace(self, trajectory: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns a trajectory with features in place of its pictures."""
    others: dict[str, Any] = {name: a for name, a in trajectory.items() if name != "image"}
    return others | {"features": self.encode(trajectory["image"])}
