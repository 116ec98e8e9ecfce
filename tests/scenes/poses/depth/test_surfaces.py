"""Cells of depth pictures and their normals."""

import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.poses.depth import surfaces
from nerf2real.scenes.poses.depth.lens import Grid

_CAMERA = Camera(width=640, height=480, fx=525.0, fy=520.0, cx=318.0, cy=243.0, k1=0.03)


def test_a_cell_is_the_median_of_what_is_measured():
  depth = np.full((480, 640), 1000, np.uint16)
  depth[:4, :4] = np.arange(2000, 2016).reshape(4, 4)
  depth[:4, 4:6] = 0  # half of the next cell
  depth[0, 8:11] = 0  # three of sixteen
  depth[1, 8] = 9000
  found = surfaces.cells(depth, 1e-3)
  assert found.shape == (120, 160)
  assert found[0, 0] == pytest.approx(2.0075, abs=1e-3)
  assert np.isnan(found[0, 1])
  assert found[0, 2] == pytest.approx(1.0)
  assert found[60, 80] == pytest.approx(1.0)


def test_a_slanted_plane_has_its_normal_and_an_edge_has_none():
  grid = Grid.of(_CAMERA, 120, 160)
  rays = grid.rays.reshape(120, 160, 3)
  normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
  depth = (-2.0 / (rays @ normal)).astype(np.float32)
  found = surfaces.normals(depth, rays)
  assert np.isnan(found[:2]).all()
  np.testing.assert_allclose(found[2:-2, 2:-2], np.broadcast_to(normal, (116, 156, 3)), atol=1e-4)
  depth[:, 80:] += 0.3
  assert np.isnan(surfaces.normals(depth, rays)[20:100, 79:81]).all()
