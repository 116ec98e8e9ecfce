"""The floor is found under a larger table, tilted, with clutter and reflections, by a facade."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.scenes.alignment import floor
from nerf2real.scenes.alignment.up import UpBelief, up_of_cameras
from tests.scenes.alignment.test_up import held


def room(rng, *, floor_points=900, table_points=4000, below=120):
  """Sparse points of a room: a textureless floor, a busy table and a wall, z up."""
  parts = [
    np.c_[
      rng.uniform(-2.5, 2.5, floor_points), rng.uniform(-2, 2, floor_points), np.zeros(floor_points)
    ],
    np.c_[
      rng.uniform(0, 1.6, table_points),
      rng.uniform(0, 1, table_points),
      np.full(table_points, 0.75),
    ],
    np.c_[np.full(2000, 2.5), rng.uniform(-2, 2, 2000), rng.uniform(0, 2.5, 2000)],
    np.c_[rng.uniform(-2.5, 2.5, 500), rng.uniform(-2, 2, 500), np.full(500, 2.5)],
    rng.uniform([-2.5, -2, -1.2], [2.5, 2, -0.1], (below, 3)),  # reflections
  ]
  points = np.concatenate(parts)
  return points + 0.006 * rng.standard_normal(points.shape)


def facade(rng, *, ground_points=2500, wall_points=20_000):
  """Points of a wall with ledges, seen from before it, and of rough ground at its foot, z up."""
  ground = np.c_[
    rng.uniform(-5, 5, ground_points),
    rng.uniform(-1.5, 0, ground_points),
    rng.normal(0, 0.03, ground_points),
  ]
  height = rng.uniform(0, 5, wall_points)
  wall = np.c_[
    rng.uniform(-5, 5, wall_points), 0.1 * (height % 1.0) + rng.normal(0, 0.02, wall_points), height
  ]
  return np.concatenate([ground, wall])


ALOFT = UpBelief.around([0, 0, 1.0], np.radians(5))
STREET = np.c_[np.linspace(-3, 3, 11), np.full(11, -5.0), np.full(11, 1.6)]
CAMERAS = np.array([[x, y, 1.4] for x in (-1.0, 0, 1) for y in (-1.0, 0, 1)])


@pytest.mark.parametrize("seed", range(4))
def test_finds_tilted_floor_below_table(seed):
  rng = np.random.default_rng(seed)
  turn = Rotation.from_rotvec(np.radians(8) * np.array([np.cos(seed), np.sin(seed), 0])).as_matrix()
  scale, shift = 0.37, np.array([0.2, -0.1, 0.4])
  points = scale * room(rng) @ turn.T + shift
  found = floor.find_floor(points, up=ALOFT, camera_positions=scale * CAMERAS @ turn.T + shift)
  truth = turn @ [0, 0, 1]
  assert np.degrees(np.arccos(found.normal @ truth)) < 0.5
  assert abs(found.offset - truth @ shift) < 0.01 * scale
  assert found.heights(shift + scale * turn @ [0.3, 0.2, 1.0]) == pytest.approx(scale, rel=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_finds_a_tilted_floor_that_holds_three_percent_of_the_points(seed):
  rng = np.random.default_rng(seed)
  turn = Rotation.from_rotvec(np.radians([-5, 4, 0])).as_matrix()
  clutter = rng.uniform([-2.5, -2, 0.03], [2.5, 2, 2.5], (25_000, 3))
  points = np.concatenate([room(rng, table_points=0), clutter]) @ turn.T
  found = floor.find_floor(points, up=ALOFT, camera_positions=CAMERAS @ turn.T)
  assert np.degrees(np.arccos(found.normal @ turn @ [0, 0, 1])) < 0.5
  assert abs(found.offset) < 0.015


def test_refinement_uses_dense_points():
  rng = np.random.default_rng(0)
  rough = floor.Floor(np.array([0.02, 0, 1.0]) / np.hypot(0.02, 1), 0.01, 100, 1.0, 0.01)
  found = floor.refine_floor(rough, room(rng, floor_points=20000), tolerance=0.08)
  assert np.degrees(np.arccos(found.normal[2])) < 0.1
  assert abs(found.offset) < 0.003


def test_says_what_is_missing():
  with pytest.raises(ValueError, match="need at least"):
    floor.find_floor(np.zeros((5, 3)), up=ALOFT, camera_positions=CAMERAS)
  wall = np.c_[np.full(500, 2.5), np.random.default_rng(0).uniform([0, 2], [2, 4], (500, 2))]
  with pytest.raises(ValueError, match="film the floor"):
    floor.find_floor(wall, up=ALOFT, camera_positions=CAMERAS)


@pytest.mark.parametrize("seed", range(3))
def test_a_wall_does_not_tilt_the_ground_before_it(seed):
  rng = np.random.default_rng(seed)
  poses = held(rng, np.pi / 2 - STREET[:, 0] / 5)  # towards the middle of the wall
  found = floor.find_floor(facade(rng), up=up_of_cameras(poses), camera_positions=STREET)
  assert np.degrees(np.arccos(found.normal[2])) < 2
  assert abs(found.heights(np.array([0, -1.0, 0]))) < 0.06


def test_a_facade_without_ground_is_refused():
  for seed in range(3):
    rng = np.random.default_rng(seed)
    wall = facade(rng, ground_points=0)
    poses = held(rng, np.pi / 2 - STREET[:, 0] / 5)
    with pytest.raises(floor.FloorError, match="show no floor"):
      floor.find_floor(wall, up=up_of_cameras(poses), camera_positions=STREET)


@pytest.mark.parametrize("roll,pitch", [(8.0, 0.0), (0.0, -35.0), (5.0, -20.0)])
@pytest.mark.parametrize("count", [3, 11])
def test_finds_the_floor_of_cameras_that_are_all_held_askew(count, roll, pitch):
  rng = np.random.default_rng(count)
  poses = held(rng, np.linspace(-0.6, 0.6, count), roll=roll, pitch=pitch)
  found = floor.find_floor(room(rng), up=up_of_cameras(poses), camera_positions=CAMERAS)
  assert np.degrees(np.arccos(found.normal[2])) < 0.5
  assert abs(found.offset) < 0.015
