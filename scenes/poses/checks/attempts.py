"""Which of several models of the same matches is right: the one that lacks least.

Where two parts of a place hang together by few pictures, the mapper's result hangs on what it
begins with. Of a phone's film of a living room, some attempts place parts of it at another scale or
turned, with as many pictures, as small a reprojection error, and no pair that contradicts: what
they see of each other becomes points of its own. So the wrong ones have less in common, see
`overlap`.
"""

from collections.abc import Callable

import numpy as np

from nerf2real.core.similarity import Similarity
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks.overlap import CLEAR, overlap
from nerf2real.scenes.poses.mapping import registered


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
  attempt: Callable[[int], pycolmap.Reconstruction | None], *, attempts: int, same: float
) -> tuple[pycolmap.Reconstruction | None, float]:
  """Returns the model that sees most of what it ought to, of several attempts, and how sure it is.

  Args:
    attempt: Makes a model from the attempt's number, or None.
    attempts: How many there are at most; none follows on two that are the same.
    same: How far such two are `apart` at most.

  Returns:
    The model, and how far it is `apart` from the nearest of those that do not see clearly less; 0
    where there is none.
  """
  found: list[tuple[float, pycolmap.Reconstruction]] = []
  for number in range(attempts):
    model = attempt(number)
    if model is None:
      continue
    found.append((overlap(model).balance if attempts > 1 else 0.0, model))
    if any(apart(model, other) <= same for _, other in found[:-1]):
      break
  if not found:
    return None, 0.0
  found.sort(key=lambda pair: -pair[0])
  (most, best), *others = found
  rivals = [model for balance, model in others if balance >= most - CLEAR * abs(most)]
  return best, min((apart(best, other) for other in rivals), default=0.0)
