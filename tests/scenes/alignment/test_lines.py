"""The point nearest to lines."""

import numpy as np

from nerf2real.scenes.alignment.lines import nearest_point


def test_lines_that_meet_give_their_point_and_two_askew_their_middle():
  rng = np.random.default_rng(0)
  origins, point = rng.normal(size=(5, 3)), np.array([0.3, -1.0, 2.0])
  ways = (point - origins) / np.linalg.norm(point - origins, axis=-1, keepdims=True)
  np.testing.assert_allclose(nearest_point(origins, ways), point, atol=1e-9)
  askew = nearest_point(np.array([[0.0, 5, 0], [3, 0, 2]]), np.array([[0.0, 1, 0], [1, 0, 0]]))
  np.testing.assert_allclose(askew, [0, 0, 1], atol=1e-9)


def test_parallel_lines_have_a_point_too():
  parallel = np.tile([0.0, 0, 1], (2, 1))
  found = nearest_point(np.array([[1.0, 0, 5], [3, 0, -2]]), parallel)
  np.testing.assert_allclose(found, [2, 0, 0], atol=1e-9)
