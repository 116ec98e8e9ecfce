"""Which of several models of the same matches is right: the one that joins most of them to points.

Where two parts of a place hang together by few pictures, the mapper's result hangs on what it
begins with. Of a phone's film of a living room, some attempts place parts of it at another scale or
turned, with as many pictures, as small a reprojection error, and no pair that contradicts: what
they see of each other becomes points of its own. So the wrong ones join fewer of the matches.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerf2real.core.similarity import Similarity
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks.agreement import matched_points
from nerf2real.scenes.poses.mapping import registered


def support(model: pycolmap.Reconstruction, database: Path) -> float:
  """Share of all verified matches that a model joins: both features see the same point.

  Args:
    model: Poses and points.
    database: Its features and verified matches.
  """
  with pycolmap.Database.open(str(database)) as db:
    total = sum(len(geometry.inlier_matches) for geometry in db.read_two_view_geometries()[1])
  seen = (points for _, _, points in matched_points(model, database))
  joined = sum(int(np.sum((p[:, 0] == p[:, 1]) & (p[:, 0] != 0))) for p in seen)
  return joined / max(total, 1)


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


def best_supported(
  attempt: Callable[[int], pycolmap.Reconstruction | None],
  database: Path,
  *,
  attempts: int,
  same: float,
) -> tuple[pycolmap.Reconstruction | None, float]:
  """Returns the model that the matches support most, of several attempts, and how sure it is.

  Args:
    attempt: Makes a model from the attempt's number, or None.
    database: Features and verified matches.
    attempts: How many there are at most; none follows on two that are the same.
    same: How far such two are `apart` at most.

  Returns:
    The model, and how far it is `apart` from the other that is nearest; 0 where there is none.
  """
  found: list[tuple[float, pycolmap.Reconstruction]] = []
  for number in range(attempts):
    model = attempt(number)
    if model is None:
      continue
    found.append((support(model, database) if attempts > 1 else 0.0, model))
    if any(apart(model, other) <= same for _, other in found[:-1]):
      break
  if not found:
    return None, 0.0
  found.sort(key=lambda pair: -pair[0])
  best, *others = (model for _, model in found)
  return best, min((apart(best, other) for other in others), default=0.0)
