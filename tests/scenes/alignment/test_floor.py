"""The floor is found under a larger table, tilted, with clutter and reflections."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.scenes.alignment import floor


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


CAMERAS = np.array([[x, y, 1.4] for x in (-1.0, 0, 1) for y in (-1.0, 0, 1)])


@pytest.mark.parametrize("seed", range(4))
def test_finds_tilted_floor_below_table(seed):
  rng = np.random.default_rng(seed)
  turn = Rotation.from_rotvec(np.radians(8) * np.array([np.cos(seed), np.sin(seed), 0])).as_matrix()
  scale, shift = 0.37, np.array([0.2, -0.1, 0.4])
  points = scale * room(rng) @ turn.T + shift
  found = floor.find_floor(
    points, up=np.array([0, 0, 1.0]), camera_positions=scale * CAMERAS @ turn.T + shift
  )
  truth = turn @ [0, 0, 1]
  assert np.degrees(np.arccos(found.normal @ truth)) < 0.5
  assert abs(found.offset - truth @ shift) < 0.01 * scale
  assert found.tilt_from_cameras_deg == pytest.approx(8, abs=0.5)
  assert found.heights(shift + scale * turn @ [0.3, 0.2, 1.0]) == pytest.approx(scale, rel=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_finds_a_tilted_floor_that_holds_three_percent_of_the_points(seed):
  rng = np.random.default_rng(seed)
  turn = Rotation.from_rotvec(np.radians([-5, 4, 0])).as_matrix()
  clutter = rng.uniform([-2.5, -2, 0.03], [2.5, 2, 2.5], (25_000, 3))
  points = np.concatenate([room(rng, table_points=0), clutter]) @ turn.T
  found = floor.find_floor(points, up=np.array([0, 0, 1.0]), camera_positions=CAMERAS @ turn.T)
  assert np.degrees(np.arccos(found.normal @ turn @ [0, 0, 1])) < 0.5
  assert abs(found.offset) < 0.015


def test_refinement_uses_dense_points():
  rng = np.random.default_rng(0)
  rough = floor.Floor(np.array([0.02, 0, 1.0]) / np.hypot(0.02, 1), 0.01, 100, 1.0, 0.01, 1.0)
  found = floor.refine_floor(rough, room(rng, floor_points=20000), tolerance=0.08)
  assert np.degrees(np.arccos(found.normal[2])) < 0.1
  assert abs(found.offset) < 0.003


def test_says_what_is_missing():
  with pytest.raises(ValueError, match="need at least"):
    floor.find_floor(np.zeros((5, 3)), up=np.array([0, 0, 1.0]), camera_positions=CAMERAS)
  wall = np.c_[np.full(500, 2.5), np.random.default_rng(0).uniform([0, 2], [2, 4], (500, 2))]
  with pytest.raises(ValueError, match="film the floor"):
    floor.find_floor(wall, up=np.array([0, 0, 1.0]), camera_positions=CAMERAS)
  rolled = np.tile(np.eye(4), (2, 1, 1))
  rolled[1, :2, :2] *= -1
  with pytest.raises(ValueError, match="override"):
    floor.mean_up(rolled)
