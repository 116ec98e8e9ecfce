"""What pictures ought to see of what others see, and do not.

Pictures before the wrong one of two things alike find there what the two have in common, and
nothing of all that stands around it. A mapper that has no use for a pair of pictures says nothing
of it; but two pictures of one place from much the same direction have features in common over most
of what both show. So the area counts over which pictures have, and that over which they ought to
and have not. How much of it is found hangs on the pictures, too: blurred ones have little in
common. It tells which of two models of the same pictures is right.

Source: Zach, Irschara and Bischof 2008, What Can Missing Correspondences Tell Us About 3D Structure
and Motion. Shapes: N pictures, P points.
"""

import math
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks.agreement import CELLS, cells_of
from nerf2real.scenes.poses.mapping import registered

# Of what pictures see of each other: a difference that tells. Chosen: of drawn rooms as photographs
# groups lack 0.05 of it at most where all places are right, 0.2 to 0.5 where a third are wrong;
# right places have a balance of 1.6 to 1.9 times such wrong ones'.
CLEAR = 0.1
_EXPECTED = 3  # points in a cell that another picture ought to see, chosen
_ANGLE = np.radians(25.0)  # between two pictures' directions to a point that both find, chosen
_RATIO = 1.4  # of their distances from it, chosen
_BEHIND = 1.2  # times the depth of what a picture sees there: a point may be hidden, chosen


class Overlap(NamedTuple):
  """What pairs of pictures have in common, symmetric."""

  ids: list[int]  # of the pictures [N]
  common: np.ndarray  # cells of both pictures with a point that both see [N, N]
  missing: np.ndarray  # cells of either all of whose points the other ought to see and does not
  balance: float
  """Cells of all pictures, each by the others that ought to see it: 1 where all do, -1 where none
  does. Of pairs there are more where all pictures stand before one thing, right or wrong; of cells
  there are not."""


class _Seen(NamedTuple):
  """What a picture sees."""

  points: np.ndarray  # rows of points [F]
  cells: np.ndarray  # of the picture, in which they lie [F]


def overlap(model: pycolmap.Reconstruction) -> Overlap:
  """Compares what pictures see with what they ought to see from their places.

  Args:
    model: Poses and points.
  """
  images = registered(model)
  keys = np.array(sorted(model.points3D), int)
  positions = np.array([model.points3D[key].xyz for key in keys]).reshape(-1, 3)
  seen = [_seen(image, model.cameras[image.camera_id], keys) for image in images]
  centers = [image.projection_center() for image in images]
  common, missing = np.zeros((2, len(images), len(images)))
  asked, sighted = np.zeros((2, len(images), CELLS))
  for other, image in enumerate(images):
    visible = _visible(model.cameras[image.camera_id], image, seen[other], positions)
    sees = np.zeros(len(keys), bool)
    sees[seen[other].points] = True
    for own, (points, cells) in enumerate(seen):
      there = np.flatnonzero(visible[points])
      if own == other or not len(there):
        continue
      rays = [positions[points[there]] - centers[row] for row in (own, other)]
      lengths = [np.linalg.norm(ray, axis=1) for ray in rays]
      cosine = (rays[0] * rays[1]).sum(1) / (lengths[0] * lengths[1])
      ratio = lengths[0] / lengths[1]
      near = there[(cosine > np.cos(_ANGLE)) & (ratio < _RATIO) & (ratio > 1 / _RATIO)]
      shared = near[sees[points[near]]]
      expected = np.bincount(cells[near], minlength=CELLS) >= _EXPECTED
      found = np.bincount(cells[shared], minlength=CELLS) > 0
      common[own, other] = (expected & found).sum()
      missing[own, other] = (expected & ~found).sum()
      asked[own] += expected
      sighted[own] += expected & found
  known = asked > 0
  return Overlap(
    [image.image_id for image in images],
    common + common.T,
    missing + missing.T,
    float((2 * sighted[known] / asked[known] - 1).sum()),
  )


def _seen(image: pycolmap.Image, camera: pycolmap.Camera, keys: np.ndarray) -> _Seen:
  features = [point for point in image.points2D if point.has_point3D()]
  pixels = np.array([point.xy for point in features]).reshape(-1, 2)
  rows = np.searchsorted(keys, [point.point3D_id for point in features])
  return _Seen(rows, cells_of(camera, pixels))


def _visible(
  camera: pycolmap.Camera, image: pycolmap.Image, seen: _Seen, positions: np.ndarray
) -> np.ndarray:
  """Whether points [P] lie in a picture, and not far behind what it sees there, bool [P]."""
  local = image.cam_from_world() * positions
  depths = local[:, 2]
  ahead = depths > 0
  pixels = np.full((len(positions), 2), -1.0)
  pixels[ahead] = camera.img_from_cam(local[ahead])
  inside = np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
  nearest = np.full(CELLS, np.inf)
  for cell in np.unique(seen.cells):
    nearest[cell] = np.quantile(depths[seen.points[seen.cells == cell]], 0.25)
  grid = np.pad(nearest.reshape(math.isqrt(CELLS), -1), 1, constant_values=np.inf)
  around = np.lib.stride_tricks.sliding_window_view(grid, (3, 3)).min((2, 3)).ravel()
  inside[inside] = depths[inside] < _BEHIND * around[cells_of(camera, pixels[inside])]
  return inside
