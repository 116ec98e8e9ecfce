"""What a part takes of free space, whatever the voxels that hold it."""

import itertools

import numpy as np
import pytest

from nerf2real.scenes.geometry import convex, surface_distance

TOLERANCE = 0.025
TRUNCATION = 0.08
SIGNS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
SLANTED = np.array([1.0, 2.0, 3.0]) / np.sqrt(14)


def _half_space(normal, surface, voxel):
  """Free space before a plane; values as fusion has them, cut off at the truncation."""
  index = np.moveaxis(np.indices((40, 40, 40)), 0, -1) * voxel
  values = np.clip((index @ normal - surface) / TRUNCATION, -1, 1)
  return convex.Space(surface_distance.signed_distance(values, voxel), np.zeros(3), voxel)


@pytest.mark.parametrize("voxel", [0.02, 0.03, 0.04])
@pytest.mark.parametrize("normal", [np.array([1.0, 0, 0]), SLANTED])
def test_distance_from_a_plane_is_exact(voxel, normal):
  surface = 0.5 * 39 * voxel * normal.sum() + 0.007
  space = _half_space(normal, surface, voxel)
  inner = space.clearance[8:-8, 8:-8, 8:-8]
  index = np.moveaxis(np.indices(inner.shape), 0, -1) + 8
  true = index * voxel @ normal - surface
  near = np.abs(true) < 0.1
  assert near.sum() > 1000
  np.testing.assert_allclose(inner[near], true[near], atol=1e-3)


def test_a_side_without_surface_is_infinitely_far():
  assert np.isposinf(surface_distance.signed_distance(np.ones((4, 4, 4)), 0.03)).all()


def _slab(surface, ahead):
  """A part that reaches so far before a plane across x."""
  lower, upper = np.array([surface - 0.2, 0.3, 0.3]), np.array([surface + ahead, 0.6, 0.6])
  part = convex.hull(lower + SIGNS * (upper - lower))
  assert part is not None
  return part


def test_whether_a_part_is_allowed_depends_on_the_surface_and_not_on_the_voxels():
  """Voxels of 3 cm had let through what reaches 6 cm, or refused what reaches none."""
  for voxel, shift in itertools.product((0.02, 0.03, 0.04), np.linspace(0, 0.04, 5)):
    surface = 0.45 + shift
    space = _half_space(np.array([1.0, 0, 0]), surface, voxel)
    for ahead, allowed in ((0.0, True), (0.02, True), (0.036, False), (0.06, False)):
      found = convex.intrusion_of(_slab(surface, ahead), space, TOLERANCE)
      assert found.allowed == allowed, (voxel, shift, ahead, found)


def test_the_volume_that_reaches_too_deep_is_measured():
  space = _half_space(np.array([1.0, 0, 0]), 0.5, 0.03)
  found = convex.intrusion_of(_slab(0.5, 0.125), space, TOLERANCE)
  assert found.volume == pytest.approx(0.325 * 0.3 * 0.3)
  assert found.bad == pytest.approx(0.1 * 0.3 * 0.3, rel=0.1)
  assert found.deep == pytest.approx(found.bad * 0.075, rel=0.1)  # its mean clearance


def test_a_part_beside_the_grid_takes_nothing():
  space = _half_space(np.array([1.0, 0, 0]), 0.5, 0.03)
  part = convex.hull(np.array([5.0, 0, 0]) + SIGNS)
  assert part is not None
  assert convex.intrusion_of(part, space, TOLERANCE).bad == 0


@pytest.mark.parametrize("stretched", [(1, 1, 1), (1, 0.4, 0.7)])
def test_a_round_part_loses_no_side_with_its_vertices(stretched):
  axis = np.arange(-0.3, 0.301, 0.02)
  grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
  ball = grid[np.linalg.norm(grid, axis=-1) <= 0.3] * stretched
  whole, part = convex.hull(ball), convex.hull(ball, max_vertices=48)
  assert 40 <= len(part.vertices) <= 48
  assert part.volume > 0.85 * whole.volume
  assert np.ptp(part.vertices, axis=0) == pytest.approx(np.ptp(ball, axis=0), rel=0.05)
