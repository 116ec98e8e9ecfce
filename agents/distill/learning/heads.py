"""The heads that only training has, fitted to what an exported policy computes.

No export holds them. Random ones would pull the LSTM and the encoder that they hang on out of where
they are: their first gradients are those of a student that knows nothing. Each head is linear, so
that the best one is a regression. Shape letters: N frames, I inputs, O outputs.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from nerf2real.agents.distill.dataset import Dataset
from nerf2real.agents.distill.learning import losses
from nerf2real.agents.distill.learning.episodes import Episodes
from nerf2real.agents.distill.learning.features import FeatureCache
from nerf2real.agents.distill.learning.updates import TrainingState, Updates
from nerf2real.agents.dmpo.networks import Params

Array = np.ndarray

_TOGETHER = 8  # episodes that go through the network at once
_RIDGE = 1e-3
"""Of the inputs' mean square, chosen: in the frames of few episodes they are nearly dependent."""


def with_fitted_heads(
  state: TrainingState, updates: Updates, *, data: Dataset, cache: FeatureCache
) -> TrainingState:
  """Returns a state whose heads predict what they stand for on the episodes so far.

  Encoder, LSTM and MLP stay as they are. Least squares with a ridge (Hoerl and Kennard 1970).

  Args:
    state: a student whose networks are an exported policy's, its inputs standardised.
    updates: of the run.
    data: with episodes that are not held out.
    cache: encodes pictures.
  """
  spans = data.spans(held_out=False)
  rows: dict[str, list[Array]] = {}
  for at in range(0, len(spans), _TOGETHER):
    episodes = Episodes(spans[at : at + _TOGETHER], data, cache, state.student["encoder"])
    batch = episodes.batch
    found = updates.inner(state, batch)
    columns = batch | {"embedding": found.embedding, "hidden": found.hidden}
    for name, values in columns.items():
      rows.setdefault(name, []).append(np.asarray(values)[episodes.present])
  return state._replace(
    student=_fitted(state.student, {n: np.concatenate(r) for n, r in rows.items()})
  )


def _fitted(student: dict[str, Params], rows: dict[str, Array]) -> dict[str, Any]:
  ball = jnp.asarray(rows["ball"]) if "ball" in rows else None
  pose = np.asarray(losses.pose_target(losses.camera_pose(jnp.asarray(rows["pose"]), ball)))
  known = np.isfinite(rows["command"]).all(axis=-1)
  encoder = student["encoder"] | {"pose": _regression(rows["features"], pose)}
  heads = student["policy"]["heads"] | {"pose": _regression(rows["embedding"], pose)}
  if known.any():
    heads["command"] = _regression(rows["hidden"][known], rows["command"][known])
  if ball is not None:
    heads["ball"] = _regression(rows["hidden"], np.asarray(losses.ball_target(ball)))
    target, seen = map(np.asarray, losses.ball_target_of_picture(ball))
    if seen.any():
      encoder["ball"] = _regression(rows["features"][seen > 0], target[seen > 0])
  return student | {"encoder": encoder, "policy": student["policy"] | {"heads": heads}}


def _regression(inputs: Array, targets: Array) -> dict[str, jax.Array]:
  """Returns the weights [I, O] and biases [O] that map inputs [N, I] to targets [N, O] best."""
  x, y = inputs.astype(np.float64), targets.astype(np.float64)
  middle, mean = x.mean(0), y.mean(0)
  x, y = x - middle, y - mean
  ridge = _RIDGE * max(float(np.mean(x**2)), 1e-12) * len(x)
  weights = np.linalg.solve(x.T @ x + ridge * np.eye(x.shape[1]), x.T @ y)
  return {
    "w": jnp.asarray(weights, jnp.float32),
    "b": jnp.asarray(mean - middle @ weights, jnp.float32),
  }
