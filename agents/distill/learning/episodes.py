"""Whole episodes of a data set as one batch, with the features of their pictures as they are."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.agents.distill.dataset import Dataset, Span
from nerf2real.agents.distill.learning.features import FeatureCache

_ROUND = 200  # steps: lengths are padded to multiples of it, so that few are compiled


class Episodes:
  """Episodes [B, T], the shorter ones padded with their last frame."""

  def __init__(self, spans: Sequence[Span], data: Dataset, cache: FeatureCache, encoder: Any):
    """Takes the episodes.

    Args:
      spans: their frames, B of them.
      data: the data set.
      cache: encodes pictures.
      encoder: the student's.
    """
    lengths = np.array([span.end - span.begin for span in spans])
    padded = -(-int(lengths.max()) // _ROUND) * _ROUND
    frames = np.stack([_padded(span, padded) for span in spans])
    features = cache.clean(encoder, frames.ravel())
    begins = np.zeros(frames.shape, np.float32)
    begins[:, 0] = 1.0
    self.batch: dict[str, Any] = data.take(frames)
    """What updates of unrolls take."""
    self.batch |= {
      "begins": begins,
      "features": features.reshape(*frames.shape, -1).astype(np.float32),
    }
    self.present = np.arange(padded) < lengths[:, None]
    """Which frames [B, T] are the episodes' own."""


def _padded(span: Span, length: int) -> np.ndarray:
  return np.minimum(np.arange(span.begin, span.begin + length), span.end - 1)
