import numpy as np

from nerf2real.scenes.field import contraction
from tests.scenes.analytic_fields import from_grid_coordinates


def test_identity_inside_and_known_values_outside():
  points = np.array([[0.3, -1.0, 0.9], [2.0, 0.0, 0.0], [-1.0, 4.0, 2.0]], np.float32)
  squashed = np.asarray(contraction.contract(points))
  np.testing.assert_allclose(squashed[0], points[0], atol=1e-7)
  np.testing.assert_allclose(squashed[1], [1.5, 0, 0], atol=1e-6)
  np.testing.assert_allclose(squashed[2], [-0.4375, 1.75, 0.875], atol=1e-6)


def test_inverse_and_range():
  rng = np.random.default_rng(0)
  points = (rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-2, 1.5, (500, 1))).astype(np.float32)
  squashed = np.asarray(contraction.contract(points))
  assert np.abs(squashed).max() < 2
  coordinates = np.asarray(contraction.grid_coordinates(points))
  assert coordinates.min() > 0 and coordinates.max() < 1
  back = from_grid_coordinates(coordinates)
  np.testing.assert_allclose(back, points, rtol=2e-4, atol=1e-5)
