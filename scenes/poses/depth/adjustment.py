"""Adjusts all poses and the lens to the surfaces and the features that pictures with depth share.

A feature tells where a picture looks, and a plain wall has few; its depth tells how far the wall is
and how it stands, in every picture. One Gauss-Newton step after the other moves all poses and the
lens at once. The poses that came hold, lightly, what neither shows. Shapes: N pictures, H x W
cells.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.poses.depth import lens
from nerf2real.scenes.poses.depth.matched import Matched
from nerf2real.scenes.poses.depth.residuals import feature_rows, surface_rows
from nerf2real.scenes.poses.depth.system import System, turns_between
from nerf2real.scenes.poses.matching.pairs import Pair

_ROUNDS = 10  # at most
_SETTLED = 2e-4  # m, root mean square, that places move by in a round that is the last
_MEDIAN = 0.6745  # of the size of a normal variable, in standard deviations
_MEDIAN_2D = 1.1774  # of the length of two of them
_CELLS_WORTH, _FEATURES_WORTH = 60, 100  # observations that a pair's rows are at most, chosen
_FIRST = 0.1  # m and rad that poses which came may be off before any is known better
_LIGHTLY = 3.0  # times what they are found to be off: errors of pictures near each other are alike
_EXACT = 1e-4  # m and rad that they are off at least


def adjust(
  poses: np.ndarray,
  camera: Camera,
  depth: np.ndarray,
  matches: Sequence[Matched],
  pairs: Sequence[Pair],
  *,
  came: np.ndarray,
  report: Progress = no_progress,
) -> tuple[np.ndarray, Camera]:
  """Returns the poses [N, 4, 4] and the camera under which surfaces and features agree best.

  Args:
    poses: World from camera [N, 4, 4] to begin with, metric.
    camera: Of the pictures.
    depth: Of cells [N, H, W] [m], NaN for none.
    matches: Features that pictures share.
    pairs: Pictures that look at the same place.
    came: Poses [N, 4, 4] as they came with the pictures.
    report: Called with the fraction done and a text.
  """
  poses, nominal, shift, turn = poses.copy(), camera, _FIRST, _FIRST
  for number in range(_ROUNDS):
    report(number / _ROUNDS, f"laying {len(poses)} pictures' surfaces onto each other")
    system = System(len(poses))
    for found, worth, median in (
      (list(surface_rows(poses, camera, depth, pairs)), _CELLS_WORTH, _MEDIAN),
      (list(feature_rows(poses, camera, matches)), _FEATURES_WORTH, _MEDIAN_2D),
    ):
      if found:
        spread = float(np.median(np.concatenate([rows.size for rows in found]))) / median
        for rows in found:
          system.add(rows, max(spread, _EXACT), worth)
    system.hold(poses, came, shift, turn)
    system.hold_lens(*lens.off(camera, nominal))
    turns, shifts, moved = system.step()
    before = poses[:, :3, 3].copy()
    poses[:, :3, 3] = np.einsum("nij,nj->ni", turns, before) + shifts
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    camera = lens.with_lens(camera, moved)
    shift, turn = _allowed((poses - came)[:, :3, 3]), _allowed(turns_between(poses, came))
    if np.sqrt(np.mean((poses[:, :3, 3] - before) ** 2)) < _SETTLED:
      break
  return poses, camera


def _allowed(off: np.ndarray) -> float:
  """Returns the deviation that poses may have, of what they are off [N, 3] those that came."""
  return _LIGHTLY * max(float(np.median(np.abs(off))) / _MEDIAN, _EXACT)
