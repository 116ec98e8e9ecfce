"""Which of several models of the same matches is right: the one that is worth most.

Where two parts of a place hang together by few pictures, the mapper's result hangs on what it
begins with: some attempts place parts of it at another scale or turned, with as many pictures, as
small a reprojection error, and no pair that contradicts. What they see of each other becomes points
of its own, so that the wrong ones of photographs have less in common (`overlap`); but parts that
are moved far apart are not expected to see each other. In a film the camera leaps between them
(`film.motion_prior.roughness`).
"""

from collections.abc import Callable

import numpy as np

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks.overlap import CLEAR
from nerf2real.scenes.poses.mapping import registered

_AS_MANY = 0.9  # of the most pictures that an attempt places, chosen


def apart(one: pycolmap.Reconstruction, two: pycolmap.Reconstruction) -> float:
  """How far a picture's places in two models are from each other at most, of the places' width.

  Models with fewer than three pictures in common are as far apart as they are wide.
  """
  places = [{i.name: i.projection_center() for i in registered(model)} for model in (one, two)]
  common = sorted(set(places[0]) & set(places[1]))
  first, second = (np.array([found[name] for name in common]).reshape(-1, 3) for found in places)
  if len(common) < 3:
    return 1.0
  off = np.linalg.norm(Similarity.fit(second, first).apply(second) - first, axis=1)
  return float(off.max() / max(np.ptp(first, axis=0).max(), 1e-12))


def best_of(
  attempt: Callable[[int], pycolmap.Reconstruction | None],
  worth: Callable[[pycolmap.Reconstruction], float],
  *,
  attempts: int,
  same: float,
  clear: float = CLEAR,
) -> tuple[pycolmap.Reconstruction | None, float]:
  """Returns the model of most worth, of attempts that place about as many pictures, and how sure it
  is.

  Args:
    attempt: Makes a model from the attempt's number, or None.
    worth: What a model is worth.
    attempts: How many there are at most; none follows on two that are the same.
    same: How far such two are `apart` at most.
    clear: Share of the best one's worth by which another is clearly worth less.

  Returns:
    The model, and how far it is `apart` from the nearest of those that are not worth clearly less;
    0 where there is none.
  """
  found: list[tuple[float, pycolmap.Reconstruction]] = []
  for number in range(attempts):
    model = attempt(number)
    if model is None:
      continue
    found.append((worth(model) if attempts > 1 else 0.0, model))
    if any(apart(model, other) <= same for _, other in found[:-1]):
      break
  if not found:
    return None, 0.0
  least = _AS_MANY * max(model.num_reg_images() for _, model in found)
  found = [pair for pair in found if pair[1].num_reg_images() >= least]
  found.sort(key=lambda pair: -pair[0])
  (most, best), *others = found
  rivals = [model for value, model in others if most - value <= clear * abs(most)]
  return best, min((apart(best, other) for other in rivals), default=0.0)
