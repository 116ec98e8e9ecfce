"""A least-squares step whose points are eliminated is that of all unknowns."""

import numpy as np
import pytest

from nerf2real.scenes.poses.elimination import Sights, eliminate


@pytest.mark.parametrize("of_all", [0, 2])
def test_steps_are_those_of_the_whole_least_squares(of_all):
  rng = np.random.default_rng(0)
  pictures, points, seen = 5, 9, (0, 1, 3, 4)  # one picture sees nothing
  others = 6 * pictures + of_all
  picture, point = (k.ravel() for k in np.meshgrid(seen, np.arange(points), indexing="ij"))
  sights = Sights(
    picture,
    point,
    rng.normal(size=(len(point), 2, 6)),
    rng.normal(size=(len(point), 2, 3)),
    rng.normal(size=(len(point), 2, of_all)),
    rng.normal(size=(len(point), 2)),
  )
  whole = np.zeros((len(point), 2, others + 3 * points))
  whole[..., 6 * pictures : others] = sights.shared
  for row, (n, k) in enumerate(zip(picture, point, strict=True)):
    whole[row, :, 6 * n :][:, :6] = sights.by_pose[row]
    whole[row, :, others + 3 * k :][:, :3] = sights.by_point[row]
  matrix, errors = whole.reshape(-1, others + 3 * points), sights.errors.ravel()
  want = np.linalg.lstsq(matrix, -errors, rcond=None)[0]  # of least size: zero of what is not seen
  reduced = eliminate(sights, pictures, damping=1e-12)
  held = reduced.curvature.diagonal() > 0
  step = np.zeros(others)
  step[held] = np.linalg.solve(reduced.curvature[held][:, held], -reduced.gradient[held])
  np.testing.assert_allclose(step, want[:others], rtol=1e-6, atol=1e-12)
  np.testing.assert_allclose(reduced.points(step).ravel(), want[others:], rtol=1e-6, atol=1e-12)
