"""The free-space map of hand-made parts, its files, its samples and goals."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from nerf2real.scenes.geometry import convex, floor_plan, free_space, map_server


def box(centre, half):
  corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
  return convex.hull(np.asarray(centre) + corners * half)


LOWER, UPPER = np.array([-2.0, -1.0, 0]), np.array([2.4, 1.4, 2.5])


@pytest.fixture(scope="module")
def ground():
  parts = [
    box([1.0, 0.6, 0.3], [0.3, 0.2, 0.3]),  # a chest
    box([-1.0, 0.0, 1.5], [0.5, 0.5, 0.2]),  # a lamp overhead
    box([-1.5, 1.2, 0.005], [0.3, 0.1, 0.005]),  # a rug
  ]
  return floor_plan.floor_plan(parts, lower=LOWER, upper=UPPER)


def test_only_matter_at_the_robots_height_blocks(ground):
  value = lambda x, y: ground.cells[tuple(ground.cell_of(np.array([x, y])))]  # noqa: E731
  assert value(1.0, 0.6) == value(1.25, 0.75) == free_space.OCCUPIED
  assert value(1.4, 0.6) == value(1.0, 0.9) == free_space.FREE
  assert value(-1.0, 0.0) == value(-1.5, 1.2) == free_space.FREE
  area = (ground.cells == free_space.OCCUPIED).sum() * ground.resolution**2
  assert area == pytest.approx(0.24, rel=0.2)


def test_slanted_part_blocks_only_where_it_is_low():
  """A wedge that rises from z = 0 at x = 0 to z = 2 at x = 2: its underside counts up to 0.6 m."""
  wedge = convex.hull(
    np.array([[0, -0.5, 0], [0, 0.5, 0], [2, -0.5, 2.0], [2, 0.5, 2.0], [2, 0, 2.1], [0, 0, 0.1]])
  )
  ground = floor_plan.floor_plan([wedge], lower=np.array([-1, -1]), upper=np.array([3, 1]))
  at = lambda x: ground.cells[tuple(ground.cell_of(np.array([x, 0.0])))]  # noqa: E731
  assert at(0.3) == at(0.5) == free_space.OCCUPIED
  assert at(0.7) == at(1.5) == free_space.FREE


def test_clearance_and_reach(ground):
  clearance = ground.clearance
  row, column = ground.cell_of(np.array([1.0, 0.0]))
  assert clearance[row, column] == pytest.approx(0.4, abs=0.06)  # to the chest's side
  assert not ground.is_reachable(np.array([1.0, 0.3]))
  assert ground.is_reachable(np.array([[1.0, 0.1], [9.0, 9.0]])).tolist() == [True, False]


def test_rooms_without_door_are_not_mixed():
  wall = box([0.5, 0.2, 0.5], [0.05, 2.0, 0.5])
  ground = floor_plan.floor_plan([wall], lower=LOWER, upper=UPPER)
  assert ground.is_reachable(np.array([-1.0, 0.0])) and not ground.is_reachable(
    np.array([1.5, 0.0])
  )


def test_map_server_files_round_trip(ground, tmp_path):
  path = tmp_path / "free_space.pgm"
  map_server.write(ground, path)
  again = map_server.read(tmp_path / "free_space.yaml")
  np.testing.assert_array_equal(again.cells, ground.cells)
  np.testing.assert_array_equal(again.origin, ground.origin)
  assert (again.resolution, again.radius) == (ground.resolution, ground.radius)
  # By the convention's words: the first row of the file is the largest y.
  raw = path.read_bytes()
  height, width = ground.cells.shape
  pixels = np.frombuffer(raw[-height * width :], np.uint8).reshape(height, width)
  x, y = 1.0, 0.6
  row = height - 1 - int((y - ground.origin[1]) / ground.resolution)
  assert pixels[row, int((x - ground.origin[0]) / ground.resolution)] == 0
  assert pixels[-1, 0] == 254
  path.with_suffix(".yaml").write_text("image: free_space.pgm\n")
  with pytest.raises(ValueError, match="lacks origin, resolution"):
    map_server.read(path)


def test_samples_are_uniform_over_the_reachable_area(ground):
  poses = ground.sample(np.random.default_rng(0), 20_000)
  assert ground.is_reachable(poses).all()
  index = ground.cell_of(poses)
  rows = np.array_split(np.argwhere(ground.reachable), 40)
  lookup = np.full(ground.cells.shape, -1)
  for number, group in enumerate(rows):
    lookup[tuple(group.T)] = number
  counts = np.bincount(lookup[tuple(index.T)], minlength=40)
  expected = len(poses) * np.array([len(group) for group in rows]) / ground.reachable.sum()
  assert stats.chisquare(counts, expected).pvalue > 1e-3
  inside = (poses[:, :2] - ground.origin) / ground.resolution % 1
  assert stats.kstest(inside[:, 0], "uniform").pvalue > 1e-3
  assert stats.kstest(poses[:, 2], "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 1e-3


def test_goals_are_free_and_far_apart(ground):
  goals = ground.default_goals()
  assert goals.shape == (3, 2) and ground.is_reachable(goals).all()
  apart = np.linalg.norm(goals[:, None] - goals[None], axis=-1)[np.triu_indices(3, 1)]
  assert apart.min() > 1.2


def test_a_grid_samples_the_reachable_floor(ground):
  floor = ground.grid((LOWER, UPPER), 0.1)
  assert floor.free.shape == (44, 24)
  np.testing.assert_allclose(floor.centres[3, 5], [-1.65, -0.45])
  np.testing.assert_array_equal(floor.free, ground.is_reachable(floor.centres))
  np.testing.assert_array_equal(floor.index_of(floor.centres[7, 2]), (7, 2))
  np.testing.assert_array_equal(floor.index_of(np.array([[-9, 9], [9, -9]])), [(0, 43), (23, 0)])
  assert floor.clearance[floor.free].min() == pytest.approx(0.1)
  assert (floor.clearance[~floor.free] == 0).all()
  path = floor.path(np.array([0.0, 0.7]), np.array([1.9, 0.7]), np.where(floor.free, 1.0, 99.0))
  np.testing.assert_allclose(path[[0, -1]], [[0.0, 0.7], [1.9, 0.7]])
  assert ground.is_reachable(path).all()  # around the chest


def test_room_around_places_and_the_nearest_place(ground):
  places = np.array([[1.0, 0.0], [-1.0, 0.0]])
  assert ground.has_room(places, 0.15).tolist() == [True, True]
  assert ground.has_room(places, 0.35).tolist() == [False, True]
  others = np.array([[1.0, 0.5], [1.0, 0.1], [1.0, 0.0]])
  np.testing.assert_array_equal(ground.nearest_reachable(np.array([1.0, 0.6]), others), [1.0, 0.1])
  np.testing.assert_array_equal(ground.nearest_reachable(np.array([0.0, 0.0]), others), [0.0, 0.0])
  with pytest.raises(free_space.FreeSpaceError, match="among 1 around"):
    ground.nearest_reachable(np.array([1.0, 0.6]), others[:1])


def test_floor_behind_a_narrow_passage_is_apart():
  walls = [box([0.0, y, 0.5], [0.1, 0.425, 0.5]) for y in (-0.575, 0.575)]  # 0.3 m between
  ground = floor_plan.floor_plan(walls, lower=[-2.0, -1.0, 0.0], upper=[1.0, 1.0, 1.0])
  assert ground.area_apart == pytest.approx((0.9 - 0.36) * (2 - 0.36), rel=0.2)  # into the gap, too
  assert ground.area == pytest.approx((1.9 - 0.36) * (2 - 0.36), rel=0.2)  # into the gap, too
  assert ground.passage_lacks == pytest.approx(2 * 0.18 - 0.3, abs=0.021)  # to a cell a side
  wide = dataclasses.replace(ground, radius=0.1)
  assert wide.passage_lacks is None
  closed = floor_plan.floor_plan(
    [*walls, box([0.0, 0.0, 0.5], [0.1, 0.2, 0.5])],
    lower=[-2.0, -1.0, 0.0],
    upper=[1.0, 1.0, 1.0],
  )
  assert closed.area_apart > 0 and closed.passage_lacks is None
  assert wide.area_apart == 0 and wide.area > ground.area + ground.area_apart


def test_no_place_to_stand_is_said():
  block = box([0.2, 0.2, 0.5], [3.0, 3.0, 0.5])
  ground = floor_plan.floor_plan([block], lower=LOWER, upper=UPPER)
  with pytest.raises(free_space.FreeSpaceError, match="no place where a robot"):
    ground.sample(np.random.default_rng(0), 1)
  with pytest.raises(free_space.FreeSpaceError):
    ground.default_goals()


@pytest.mark.parametrize("text", ["image: [", "just words", "\x00"])
def test_a_damaged_map_is_one_clear_line(tmp_path, text):
  path = tmp_path / "free_space.yaml"
  path.write_text(text)
  with pytest.raises(ValueError, match=r"^The map .* (is no YAML file|holds)") as error:
    map_server.read(path)
  assert "\n" not in str(error.value)
