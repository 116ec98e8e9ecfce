"""Errors of a student on episodes that were held out, with pictures as they are.

Shape letters: B episodes, T steps.
"""

import jax
import numpy as np

from nerf2real.agents.distill.dataset import Dataset
from nerf2real.agents.distill.learning.episodes import Episodes
from nerf2real.agents.distill.learning.features import FeatureCache
from nerf2real.agents.distill.learning.updates import TrainingState, Updates

_EPISODES = 8  # evenly spread over those held out: a tenth of a second for the network each


def validate(
  state: TrainingState, updates: Updates, *, data: Dataset, cache: FeatureCache
) -> dict[str, float]:
  """Returns medians over frames: the pose's errors from one picture and from the LSTM [m, rad], and
  the mean absolute error of actions; empty while no episode is held out."""
  held = data.spans(held_out=True)
  if not held:
    return {}
  spans = [held[i] for i in np.linspace(0, len(held) - 1, _EPISODES).astype(int)]
  episodes = Episodes(spans, data, cache, state.student["encoder"])
  found = jax.device_get(updates.predict(state, episodes.batch))
  return {name: float(np.median(values[episodes.present])) for name, values in found.items()}
