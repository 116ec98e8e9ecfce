"""The occupancy grid against shapes known in closed form and brute force."""

import numpy as np
import pytest

from nerf2real.scenes.field import occupancy
from nerf2real.scenes.field.field import FieldSettings
from tests.scenes import analytic_fields
from tests.scenes.analytic_fields import from_grid_coordinates
from tests.scenes.field.render.reference import is_occupied

SETTINGS = occupancy.OccupancySettings(cells=128)
CENTRES = np.array([[0.3, -0.2, 0.1], [2.5, 0.4, 0.3]])  # the second lies in squashed space
RADII = np.array([0.2, 0.9])


def _distance(points: np.ndarray) -> np.ndarray:
  return (np.linalg.norm(points[..., None, :] - CENTRES, axis=-1) - RADII).min(-1)


@pytest.fixture(scope="module")
def found() -> occupancy.Occupancy:
  field = analytic_fields.from_signed_distance(
    _distance, settings=FieldSettings(levels=1, log2_table_size=18, base_resolution=62)
  )
  return occupancy.build(field, settings=SETTINGS)


def test_distance_is_the_maximum_norm_to_the_nearest_matter():
  occupied = np.zeros((20, 20, 20), bool)
  occupied[3, 4, 5] = occupied[15, 2, 9] = occupied[10, 19, 0] = True
  grid = occupancy.Occupancy.from_occupied(occupied)
  matter = np.argwhere(occupied)
  cells = np.argwhere(np.ones_like(occupied))
  expected = np.abs(cells[:, None] - matter).max(-1).min(-1).reshape(occupied.shape)
  np.testing.assert_array_equal(grid.distance, expected)


def test_matter_is_found_inside_and_outside_the_unit_cube(found):
  random = np.random.default_rng(0)
  # Outside the cube the field's cells are long: only the middle of that ball is sure.
  for centre, radius, part in zip(CENTRES, RADII, (0.9, 0.7), strict=True):
    offset = random.normal(size=(2000, 3))
    offset *= (radius * random.random((2000, 1)) ** (1 / 3)) / np.linalg.norm(
      offset, axis=-1, keepdims=True
    )
    inside = centre + part * offset
    assert is_occupied(found, inside).all()


def test_free_space_is_empty(found):
  z, y, x = np.meshgrid(*[(np.arange(128) + 0.5) / 128] * 3, indexing="ij")
  points = from_grid_coordinates(np.stack([x, y, z], -1))
  near = np.abs(points).max(-1) < 1.0
  # The field itself is trilinear between vertices 0.065 apart; one cell is 0.031.
  assert not (found.distance[near & (_distance(points) > 0.08)] == 0).any()
  assert (found.distance[near & (_distance(points) < -0.04)] == 0).all()
  assert found.distance[near].max() > 10


@pytest.mark.parametrize("layer", [64, 65, 66, 69])
def test_a_plate_that_stands_by_itself_is_found_wherever_it_is(layer):
  """A table's top is thinner than what coarse looks are apart, and nothing near it is dense."""
  cells = 126
  height, half = 4 * layer / cells - 2, np.array([0.3, 0.3, 0.012])

  def plate(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points - [0.1, 0.05, height]) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)

  shape = FieldSettings(levels=1, log2_table_size=21, base_resolution=cells)
  found = occupancy.build(analytic_fields.from_signed_distance(plate, settings=shape))
  x, y = np.meshgrid(np.linspace(-0.15, 0.35, 40), np.linspace(-0.2, 0.3, 40))
  inside = np.stack([x, y, np.full_like(x, height)], axis=-1)
  assert is_occupied(found, inside).all()
  beside = inside + np.array([0, 0, 0.15])
  assert not is_occupied(found, beside).any()


def test_empty_grids_and_wrong_shapes():
  nothing = occupancy.Occupancy.from_occupied(np.zeros((8, 8, 8), bool))
  assert nothing.distance.min() == 255
  with pytest.raises(ValueError, match="cube of cells"):
    occupancy.Occupancy.from_occupied(np.zeros((8, 8, 4), bool))
  with pytest.raises(ValueError, match="expected at least 4"):
    occupancy.OccupancySettings(cells=3)
