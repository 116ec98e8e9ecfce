"""Convex parts: which are merged, and that unseen space is matter behind seen matter alone."""

import numpy as np
from scipy import ndimage

from nerf2real.scenes.geometry import convex, decomposition, fusion, merging

VOXEL = 0.05
SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def _box(centre, half):
  part = convex.hull(np.add(centre, SIGNS * half))
  assert part is not None
  return part


# Two halves of a bar, a block that stands out from it by a hand, and one by far more.
BOXES = {
  "left": ((0.5, 0.5, 0.5), (0.25, 0.25, 0.25)),
  "right": ((1.0, 0.5, 0.5), (0.25, 0.25, 0.25)),
  "step": ((1.5, 0.75, 0.5), (0.25, 0.25, 0.25)),
  "tower": ((2.0, 0.9, 1.2), (0.25, 0.5, 0.9)),
}


def _space():
  index = np.moveaxis(np.indices((56, 40, 50)), 0, -1) * VOXEL
  matter = np.zeros(index.shape[:3], bool)
  for centre, half in BOXES.values():
    matter |= (np.abs(index - centre) <= np.add(half, 1e-6)).all(-1)
  return convex.Space(
    (ndimage.distance_transform_edt(~matter) * VOXEL).astype(np.float32), np.zeros(3), VOXEL
  )


def _merged(max_parts):
  parts = [_box(*box) for box in BOXES.values()]
  return merging.merge(parts, _space(), tolerance=0.06, max_parts=max_parts, max_vertices=48)


def test_parts_that_take_no_free_space_become_one():
  found = _merged(100)
  assert len(found) == 3
  assert any(np.isclose(part.volume, 0.25) for part in found)  # both halves of the bar


def test_too_many_parts_lose_the_least_free_space():
  found = sorted(_merged(2), key=lambda part: part.volume)
  assert len(found) == 2
  tower = max(found, key=lambda part: part.vertices[:, 2].max())
  np.testing.assert_allclose(tower.volume, 0.9)  # untouched: the bar took the step
  assert len(_merged(1)) == 1


def test_unseen_space_away_from_matter_is_no_part():
  shape = (50, 50, 30)
  values, weights = np.ones(shape, np.float32), np.ones(shape, np.float32)
  values[:3] = -1.0  # a wall that was seen
  weights[15:35, 15:35] = 0.0  # a column of a metre that nobody looked at
  weights[:2, 20:30] = 0.0  # and the inside of the wall
  grid = fusion.Grid(values, weights, np.zeros(3), VOXEL, 0.1)
  parts = decomposition.decompose(grid)
  assert max(part.vertices[:, 0].max() for part in parts) < 0.3
  inside = [
    (np.array([0.05, 1.25, 0.7]) @ part.planes[:, :3].T + part.planes[:, 3] < 0).all()
    for part in parts
  ]
  assert any(inside)
