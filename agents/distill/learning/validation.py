"""Errors of a student on episodes that were held out, with pictures as they are.

Shape letters: B episodes, T steps.
"""

from typing import Any

import jax
import numpy as np

from nerf2real.agents.distill.dataset import Dataset, Span
from nerf2real.agents.distill.learning.features import FeatureCache
from nerf2real.agents.distill.learning.updates import TrainingState, Updates

_EPISODES = 8  # evenly spread over those held out: a tenth of a second for the network each
_ROUND = 200  # steps: lengths are padded to multiples of it, so that few are compiled


def validate(
  state: TrainingState, updates: Updates, *, data: Dataset, cache: FeatureCache
) -> dict[str, float]:
  """Returns medians over frames: the pose's errors from one picture and from the LSTM [m, rad], and
  the mean absolute error of actions; empty while no episode is held out."""
  held = data.spans(held_out=True)
  if not held:
    return {}
  spans = [held[i] for i in np.linspace(0, len(held) - 1, _EPISODES).astype(int)]
  lengths = np.array([span.end - span.begin for span in spans])
  padded = -(-int(lengths.max()) // _ROUND) * _ROUND
  frames = np.stack([_padded(span, padded) for span in spans])
  batch: dict[str, Any] = data.take(frames)
  batch["begins"] = np.zeros(frames.shape, np.float32)
  batch["begins"][:, 0] = 1.0
  features = cache.clean(state.student["encoder"], frames.ravel())
  batch["features"] = features.reshape(*frames.shape, -1).astype(np.float32)
  present = np.arange(padded) < lengths[:, None]
  found = jax.device_get(updates.predict(state, batch))
  return {name: float(np.median(values[present])) for name, values in found.items()}


def _padded(span: Span, length: int) -> np.ndarray:
  return np.minimum(np.arange(span.begin, span.begin + length), span.end - 1)
