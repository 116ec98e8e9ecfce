"""Similarity transforms against their definition."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain, to_plain


@pytest.fixture
def transform():
  return Similarity(2.5, Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix(), np.arange(3.0))


def test_fit_recovers_a_known_transform(transform):
  points = np.random.default_rng(1).normal(size=(30, 3))
  found = Similarity.fit(points, transform.apply(points))
  assert found.scale == pytest.approx(2.5)
  np.testing.assert_allclose(found.rotation, transform.rotation, atol=1e-12)
  np.testing.assert_allclose(found.translation, transform.translation, atol=1e-12)


def test_points_that_are_far_off_do_not_move_the_fit_of_most(transform):
  random = np.random.default_rng(1)
  points = random.normal(size=(40, 3))
  moved = transform.apply(points)
  moved[:8] += [2.0, 0.0, 1.0]
  exact = Similarity.fit_most(points, moved)
  assert exact.scale == pytest.approx(2.5)
  np.testing.assert_allclose(exact.rotation, transform.rotation, atol=1e-9)
  moved += random.normal(size=moved.shape) * 0.01
  found = Similarity.fit_most(points, moved)
  right = Similarity.fit(points[8:], moved[8:])
  assert found.scale == pytest.approx(right.scale, rel=1e-3)
  np.testing.assert_allclose(found.apply(points), right.apply(points), atol=0.01)
  plain = Similarity.fit(points, moved).apply(points)
  assert np.median(np.linalg.norm(plain - moved, axis=1)) > 0.1
  rigid = Similarity.fit_most(points, moved / 2.5, with_scale=False)
  assert rigid.scale == 1.0
  np.testing.assert_allclose(rigid.rotation, transform.rotation, atol=0.01)


def test_fit_never_mirrors():
  points = np.random.default_rng(2).normal(size=(10, 3))
  found = Similarity.fit(points, points * [1, 1, -1])
  assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_composition_and_inverse(transform):
  points = np.random.default_rng(3).normal(size=(5, 3))
  np.testing.assert_allclose(
    (transform @ transform).apply(points), transform.apply(transform.apply(points))
  )
  np.testing.assert_allclose(transform.inverse().apply(transform.apply(points)), points)
  again = from_plain(to_plain(transform), Similarity)
  np.testing.assert_array_equal(again.apply(points), transform.apply(points))


def test_poses_stay_rigid(transform):
  pose = np.eye(4)
  pose[:3, 3] = [1, 2, 3]
  moved = transform.apply_pose(pose)
  np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
  np.testing.assert_allclose(moved[:3, 3], transform.apply(pose[:3, 3]))


def test_fit_needs_three_points():
  with pytest.raises(ValueError, match="at least 3"):
    Similarity.fit(np.zeros((2, 3)), np.zeros((2, 3)))
