"""Which of several models of the same matches is right: the one that joins most of them to points.

Where two parts of a place hang together by few pictures, the mapper's result hangs on what it
begins with. Of a phone's film of a living room, some attempts place parts of it at another scale or
turned, with as many pictures, as small a reprojection error, and no pair that contradicts: what
they see of each other becomes points of its own. So the wrong ones join fewer of the matches.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.agreement import matched_points

_SAME = 0.002
"""Difference of the support of two models that are the same; chosen: of five of the living room two
were, by 0.0002, and the others at least 0.004 apart."""


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


def best_supported(
  attempt: Callable[[int], pycolmap.Reconstruction | None], database: Path, *, attempts: int
) -> pycolmap.Reconstruction | None:
  """Returns the model that the matches support most, of several attempts.

  Args:
    attempt: Makes a model from the attempt's number, or None.
    database: Features and verified matches.
    attempts: How many there are at most; none follows on two that are the same.
  """
  best, shares = None, list[float]()
  for number in range(attempts):
    model = attempt(number)
    if model is None:
      continue
    share = support(model, database) if attempts > 1 else 0.0
    if best is None or share > max(shares):
      best = model
    if any(abs(share - other) <= _SAME for other in shares):
      break
    shares.append(share)
  return best
