"""The paper's counts, and starts that are the same for every policy."""

import collections
import types

import numpy as np
import pytest

from nerf2real.scenes.geometry.free_space import FreeSpace
from nerf2real.suite import protocols


def test_navigation_has_every_combination_twice():
  trials = protocols.navigation()
  assert len(trials) == 54
  counts = collections.Counter((t.goal, t.position, round(t.yaw, 6)) for t in trials)
  assert len(counts) == 27 and set(counts.values()) == {2}
  assert len({t.seed for t in trials}) == 54


def test_ball_protocols():
  center, wall = protocols.ball_center(), protocols.ball_wall()
  assert len(center) == 32 and len(wall) == 14
  assert len({t.robot_xy for t in center}) == 8
  assert {t.ball_xy for t in center} == {(0.0, 0.0)}
  assert all(t.robot_xy == (0.0, 0.0) for t in wall)
  assert {round(t.robot_yaw, 6) for t in wall} == {round(np.pi / 4, 6)}
  cells = collections.Counter((round(t.ball_xy[0]), round(t.ball_xy[1])) for t in wall)
  assert len(cells) == 7 and set(cells.values()) == {2}
  assert protocols.TARGET_CELL not in cells and (0, 0) not in cells
  assert protocols.ball_wall() == wall


def test_camera_gain_ratios():
  trials = protocols.camera_gain()
  counts = collections.Counter(t.camera_gain for t in trials)
  assert counts == dict.fromkeys((2.56, 1.8, 1.0, 0.2, 0.02), 5)
  assert len({(t.goal, t.position, t.yaw) for t in trials}) == 1
  assert {name: len(trials()) for name, trials in protocols.PROTOCOLS.items()} == {
    "navigation": 54,
    "ball": 46,
    "gain": 25,
  }


def test_navigation_starts_are_spread_and_fixed():
  grid = np.stack(np.meshgrid(np.linspace(0, 4, 41), np.linspace(0, 3, 31)), -1).reshape(-1, 2)
  goals = np.array([[0.5, 0.5], [3.5, 2.5]])
  starts = protocols.navigation_starts(grid, goals)
  np.testing.assert_array_equal(starts, protocols.navigation_starts(grid, goals))
  gaps = np.linalg.norm(starts[:, None] - starts, axis=-1)[np.triu_indices(3, 1)]
  assert gaps.min() > 1.0
  assert np.linalg.norm(starts[:, None] - goals, axis=-1).min() >= 1.0
  with pytest.raises(ValueError, match="at least 3"):
    protocols.navigation_starts(grid[:2], goals)
  # A scene with no place far from the goals still gets starts: the farthest there are.
  near = protocols.navigation_starts(grid[np.linalg.norm(grid - goals[0], axis=1) < 0.3], goals)
  assert near.shape == (3, 2)


class _Bays(FreeSpace):
  """A square floor in a room 6 m long whose narrow bays at both ends are farthest apart."""

  def __init__(self, half_width):
    self._half_width = half_width

  def sample(self, rng, count):
    return rng.uniform(-self._half_width, self._half_width, (count, 3))

  def is_reachable(self, points):
    x, y = np.moveaxis(np.asarray(points), -1, 0)
    bay = (np.abs(y - 1.0) < 0.06) & (np.abs(x) < 3.0)
    return bay | ((np.abs(x) < self._half_width) & (np.abs(y) < self._half_width))


def _room(half_width, *, goals):
  extent = (np.full(2, -3.0), np.full(2, 3.0))
  return types.SimpleNamespace(extent=extent, goals=np.array(goals), free_space=_Bays(half_width))


def test_starts_have_room_to_turn():
  scene = _room(2.0, goals=[[0.0, 0.0]])
  starts = protocols.scene_starts(scene)
  np.testing.assert_array_equal(starts, protocols.scene_starts(scene))
  assert (np.abs(starts) <= 2.0 - protocols.START_ROOM).all()  # none in a bay, none at a wall
  gaps = np.linalg.norm(starts[:, None] - starts, axis=-1)[np.triu_indices(3, 1)]
  assert gaps.min() > 2.0
  assert np.linalg.norm(starts, axis=1).min() >= protocols.MIN_GOAL_DISTANCE


def test_starts_in_a_cramped_scene_have_what_there_is():
  scene = _room(0.1, goals=[[0.0, 0.0]])  # only the bays are far from the goal
  starts = protocols.scene_starts(scene)
  assert starts.shape == (3, 2) and (np.linalg.norm(starts, axis=1) >= 1.0).all()
