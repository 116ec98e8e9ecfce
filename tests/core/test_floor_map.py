"""Top-down floor maps: where cells, marks and heat land in the picture."""

import numpy as np
import pytest

from nerf2real.core import floor_map, palette
from nerf2real.core.floor_map import Floor, FloorMap

RED = (255, 0, 0)


@pytest.fixture
def floor():
  """A floor of 4 m by 2 m from (-1, 3): matter at its lower left, its right never seen."""
  reachable = np.zeros((4, 8), bool)
  reachable[2, 3] = True  # centre at x 0.75, y 4.25
  occupied, unknown = np.zeros((2, 4, 8), bool)
  occupied[0, 0] = unknown[:, 7] = True
  return Floor(
    reachable=reachable,
    resolution=0.5,
    origin=np.array([-1.0, 3.0]),
    occupied=occupied,
    unknown=unknown,
  )


def pixel(drawn: FloorMap, x: float, y: float) -> tuple[int, ...]:
  height, width = drawn.picture.shape[:2]
  x_from, x_to, y_from, y_to = drawn.extent
  column = int((x - x_from) / (x_to - x_from) * width)
  row = int((y_to - y) / (y_to - y_from) * height)
  return tuple(drawn.picture[row, column].tolist())


def test_cells_lie_where_the_world_has_them_with_y_upwards(floor):
  drawn = FloorMap.of(floor, height=100)
  assert drawn.extent == (-1, 3, 3, 5) and drawn.picture.shape == (100, 200, 3)
  assert pixel(drawn, -0.75, 3.25) == floor_map.OCCUPIED
  assert pixel(drawn, 0.75, 4.25) == floor_map.REACHABLE
  assert pixel(drawn, 2.75, 4.9) == floor_map.UNKNOWN
  assert pixel(drawn, 0.3, 4.25) == floor_map.FREE


def test_extent_may_reach_beyond_the_cells(floor):
  drawn = FloorMap.of(floor, height=120, extent=(-2.0, 4.0, 2.0, 5.0))
  assert drawn.picture.shape == (120, 240, 3)
  assert pixel(drawn, -0.75, 3.25) == floor_map.OCCUPIED
  assert pixel(drawn, -1.5, 2.5) == floor_map.FREE


def test_marks_are_drawn_at_their_places_in_metres(floor):
  blank = FloorMap.of(floor, height=400)
  drawn = blank.copy().disc(np.array([0.0, 4.5]), 0.2, RED).box((1, 3.5), (2, 4.5), RED)
  drawn.path(np.array([(-0.5, 3.2), (2.5, 3.2)]), RED)
  assert pixel(drawn, 0.15, 4.5) == pixel(drawn, 0.0, 4.65) == RED
  assert pixel(drawn, 0.25, 4.5) != RED
  assert pixel(drawn, 1.5, 3.5) == pixel(drawn, 2.0, 4.0) == pixel(drawn, 1.0, 3.2) == RED
  assert pixel(drawn, 1.5, 4.0) != RED
  assert not (blank.picture == RED).all(-1).any()  # a copy is drawn on, not the original


def test_a_robot_looks_along_its_yaw(floor):
  drawn = FloorMap.of(floor, height=400).robot(np.array([0.0, 4.0]), np.pi / 2, RED)
  assert pixel(drawn, 0.0, 4.25) == RED != pixel(drawn, 0.25, 4.0)


def test_heat_has_row_0_at_the_top_and_dims_the_rest(floor):
  density = np.zeros((4, 8))
  density[0, 1] = 3.0  # x -0.25, y 4.75
  drawn = FloorMap.of(floor, height=100).heat(density)
  assert sum(pixel(drawn, -0.25, 4.75)) > 500
  assert max(pixel(drawn, 0.75, 3.75)) == round(0.6 * max(floor_map.FREE))


def test_scale_bar_has_its_length(floor):
  drawn = FloorMap.of(floor, height=400).scale_bar()
  ink = (drawn.picture[388] == palette.rgb(palette.INK)).all(-1)
  assert 200 <= ink.sum() <= 203  # 200 pixel a metre


def test_colors_of_many_things_repeat():
  assert palette.cycle(0) == palette.cycle(8) != palette.cycle(1)
  assert palette.rgb("#0072B2") == (0, 114, 178)
