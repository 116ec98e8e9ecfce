"""The free floor is drawn as few rectangles that cover exactly its cells."""

import numpy as np

from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.geometry.free_space import FREE, OCCUPIED, FreeSpaceMap
from nerf2real.scenes.viewing.bundle_viewer import free_floor_mesh


def area_and_shape(space):
  vertices, faces = free_floor_mesh(space, height=0.02)
  corners = vertices[faces]
  normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
  assert (normal[:, 2] > 0).all() and (vertices[:, 2] == 0.02).all()
  return 0.5 * normal[:, 2].sum(), vertices, faces


def test_rectangles_cover_the_reachable_cells():
  cells = np.full((5, 7), FREE, np.uint8)
  cells[2, 3] = OCCUPIED  # rows above and below are whole, this one falls into two
  space = FreeSpaceMap(cells=cells, resolution=0.1, origin=np.array([1.0, -2.0]), radius=0.01)
  area, vertices, faces = area_and_shape(space)
  assert len(faces) == 2 * 4  # above, below, left and right of the hole
  np.testing.assert_allclose(area, 34 * 0.01)
  np.testing.assert_allclose(vertices[:, :2].min(0), [1.0, -2.0])
  np.testing.assert_allclose(vertices[:, :2].max(0), [1.7, -1.5])


def test_the_shipped_room_is_of_few_triangles():
  space = Bundle.load().free_space
  area, _, faces = area_and_shape(space)
  np.testing.assert_allclose(area, space.area)
  assert len(faces) < 0.05 * 2 * space.reachable.sum()


def test_no_free_floor_is_an_empty_mesh():
  cells = np.full((3, 3), OCCUPIED, np.uint8)
  empty = FreeSpaceMap(cells=cells, resolution=0.1, origin=np.zeros(2), radius=0.1)
  vertices, faces = free_floor_mesh(empty, height=0.0)
  assert vertices.shape == (0, 3) and faces.shape == (0, 3)
