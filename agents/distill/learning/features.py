"""Cached features of a frozen encoder: several augmented copies of every frame.

Shape letters: N frames, C copies, F features.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from nerf2real.agents.distill.dataset import Dataset

_CHUNK = 512  # frames that are encoded at once
_MIN_NEW = 2_048  # frames worth a call


class FeatureCache:
  """Features of a data set's frames; new frames are added with `extend`."""

  def __init__(
    self,
    encode: Callable[..., jax.Array],
    data: Dataset,
    *,
    copies: int,
    width: int,
    seed: int,
  ):
    """Creates an empty cache.

    Args:
      encode: `learning.Updates.features`.
      data: the data set.
      copies: C; the first is of the pictures as they are, the others of augmented ones.
      width: F.
      seed: of the augmentation.
    """
    self._encode, self._data = encode, data
    capacity = len(data.arrays["image"])
    self._features = np.empty((copies, capacity, width), np.float16)
    self._key = jax.random.PRNGKey(seed)
    self.frames = 0  # encoded

  def clear(self) -> None:
    """Discards all features, such as when the encoder has changed."""
    self.frames = 0

  def extend(self, encoder: Any) -> None:
    """Encodes frames that came since, if they are many enough or there are none yet."""
    end = self._data.frames
    if self.frames and end - self.frames < _MIN_NEW:
      return
    for begin in range(self.frames, end, _CHUNK):
      frames = np.arange(begin, min(begin + _CHUNK, end))
      for copy in range(len(self._features)):
        self._key, key = jax.random.split(self._key)
        self._features[copy, frames] = self._chunk(encoder, frames, key if copy else None)
    self.frames = end

  def clean(self, encoder: Any, frames: np.ndarray) -> np.ndarray:
    """Returns features [N, F] of frames [N] as they are, without the cache."""
    parts = [
      self._chunk(encoder, frames[i : i + _CHUNK], None) for i in range(0, len(frames), _CHUNK)
    ]
    return np.concatenate(parts)

  def take(self, frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns features [B, T, F] of unrolls [B, T], of a copy drawn for each stream."""
    copies = rng.integers(len(self._features), size=(len(frames), 1))
    return self._features[copies, frames].astype(np.float32)

  def _chunk(self, encoder: Any, frames: np.ndarray, key: jax.Array | None) -> np.ndarray:
    padded = np.resize(frames, _CHUNK)
    return np.asarray(self._encode(encoder, self._data.arrays["image"][padded], key))[: len(frames)]
