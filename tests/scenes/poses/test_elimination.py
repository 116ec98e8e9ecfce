"""A least-squares step whose points are eliminated is that of all unknowns."""

import numpy as np
from scipy import sparse

from nerf2real.scenes.poses.elimination import eliminate


def test_steps_are_those_of_the_whole_least_squares():
  rng = np.random.default_rng(0)
  others, points, sights = 7, 5, 40
  point = rng.permuted(np.tile(np.arange(points), sights // points))
  by_others, by_points = rng.normal(size=(2 * sights, others)), rng.normal(size=(sights, 2, 3))
  errors = rng.normal(size=2 * sights)
  whole = np.zeros((sights, 2, others + 3 * points))
  whole[..., :others] = by_others.reshape(sights, 2, others)
  for row, k in enumerate(point):
    whole[row, :, others + 3 * k :][:, :3] = by_points[row]
  want = np.linalg.lstsq(whole.reshape(len(errors), -1), -errors, rcond=None)[0]
  reduced = eliminate(sparse.csr_matrix(by_others), by_points, point, errors, damping=1e-12)
  step = np.linalg.solve(reduced.curvature, -reduced.gradient)
  np.testing.assert_allclose(step, want[:others], rtol=1e-6)
  np.testing.assert_allclose(reduced.points(step).ravel(), want[others:], rtol=1e-6)
