"""The training's heads of a student that begins with a policy: regressions on what it computes."""

import jax
import numpy as np
import pytest

from nerf2real.agents.distill.dataset import Dataset, fields, transition_fields
from nerf2real.agents.distill.learning.episodes import Episodes
from nerf2real.agents.distill.learning.features import FeatureCache
from nerf2real.agents.distill.learning.heads import with_fitted_heads
from tests.agents.distill.test_student import LAYOUT, TINY, make_state

WIDTH = TINY.agent.network.image_features


@pytest.fixture
def setting(tmp_path):
  """A student with its updates, and three episodes of drawn pictures."""
  updates, state = make_state(seed=4)
  data = Dataset(tmp_path, LAYOUT, capacity=1_000, holdout=3)
  rng = np.random.default_rng(0)
  kept = fields(LAYOUT) | transition_fields(LAYOUT)
  for number, frames in enumerate((120, 40, 90)):
    episode = {
      name: np.zeros((frames, *shape), dtype)
      if dtype == np.uint8
      else rng.normal(size=(frames, *shape)).astype(dtype)
      for name, (shape, dtype) in kept.items()
    }
    brightness = rng.integers(0, 256, (frames, 1, 1, 3))
    episode["image"] += (brightness * rng.uniform(0.2, 1.0, (12, 16, 1))).astype(np.uint8)
    data.insert(episode, 1, number)
  cache = FeatureCache(updates.features, data, copies=2, width=WIDTH, seed=0)
  return updates, state, data, cache


def _inner(updates, state, data, cache):
  episodes = Episodes(data.spans(held_out=False), data, cache, state.student["encoder"])
  found = updates.inner(state, episodes.batch)
  return episodes, np.asarray(found.embedding), np.asarray(found.hidden)


def test_heads_are_what_their_targets_depend_on(setting):
  updates, state, data, cache = setting
  episodes, embedding, hidden = _inner(updates, state, data, cache)
  weights = np.random.default_rng(1).normal(size=(hidden.shape[-1], 2))
  at = np.concatenate([np.arange(s.begin, s.end) for s in data.spans(held_out=False)])
  data.arrays["command"][at] = (hidden @ weights + 0.3)[episodes.present]
  data.arrays["command"][at[5]] = np.nan  # a teacher without a command
  data.arrays["pose"][at] = 0.0
  data.arrays["pose"][at, 0] = 2.0 * embedding[episodes.present][:, 0] + 1.0
  fitted = with_fitted_heads(state, updates, data=data, cache=cache)
  heads = fitted.student["policy"]["heads"]
  told = hidden @ np.asarray(heads["command"]["w"]) + np.asarray(heads["command"]["b"])
  wanted = hidden @ weights + 0.3
  spread = wanted[episodes.present].std()
  assert np.abs(told - wanted)[episodes.present].max() < 0.05 * spread
  pose = embedding @ np.asarray(heads["pose"]["w"]) + np.asarray(heads["pose"]["b"])
  x = embedding[..., 0] + 0.5
  assert np.abs(pose[..., 0] - x)[episodes.present].max() < 0.05 * x[episodes.present].std()
  np.testing.assert_allclose(pose[episodes.present][:, 1:], [[0.0, 1.0, 0.0]] * len(at), atol=1e-4)


def test_the_policy_itself_stays(setting):
  updates, state, data, cache = setting
  fitted = with_fitted_heads(state, updates, data=data, cache=cache)

  def without(student):
    kept = {"policy": dict(student["policy"]), "encoder": dict(student["encoder"])}
    del kept["policy"]["heads"], kept["encoder"]["pose"]
    return kept | {"belief": student["belief"]}

  same = jax.tree.map(
    lambda a, b: bool((a == b).all()), without(fitted.student), without(state.student)
  )
  assert all(jax.tree.leaves(same))
