"""The pictures' lens, and how what they see changes with it."""

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.poses.depth import lens

_CAMERA = Camera(width=640, height=480, fx=525.0, fy=520.0, cx=318.0, cy=243.0, k1=0.03)


def test_rays_change_with_the_lens_as_they_say():
  pixels = np.random.default_rng(0).uniform([0, 0], [640, 480], (50, 2))
  change = np.array([3.0, -2.0, 4.0, 1.0, 0.01, -0.005, 0.001, 0.0005])
  moved = lens.with_lens(_CAMERA, 0.01 * change).rays(pixels) - _CAMERA.rays(pixels)
  expected = 0.01 * lens.rays_by_lens(_CAMERA, pixels) @ change
  np.testing.assert_allclose(moved, expected, atol=2e-7)
  points = _CAMERA.rays(pixels) * 3.0
  moved = lens.with_lens(_CAMERA, 0.01 * change).project(points) - pixels
  np.testing.assert_allclose(moved, 0.01 * lens.pixels_by_lens(_CAMERA, points) @ change, atol=2e-5)
