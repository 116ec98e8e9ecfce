"""Where a robot has to walk to push a ball: behind it, around it, and where there is room."""

import numpy as np
import pytest

from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.gaits.planner import Planner
from nerf2real.suite.gaits.pushing import Push, PushSettings

SETTINGS = PushSettings()
BALL, TARGET = np.zeros(2), np.array([1.0, 0.0])


class _WallBehind(EmptyFloor):
  """A floor with a wall at x < -0.2: a robot cannot stand straight behind the ball."""

  def __init__(self):
    super().__init__(extent=(np.full(2, -2.0), np.full(2, 2.0)))
    self.free_space.is_reachable = lambda points: np.asarray(points)[..., 0] > -0.2


class _Room(EmptyFloor):
  def __init__(self):
    super().__init__(extent=(np.full(2, -2.0), np.full(2, 2.0)))


def test_behind_the_ball_it_pushes_and_steers_the_offset_away():
  push = Push(Planner(_Room()), SETTINGS)
  way = push.way(np.array([-0.3, 0.03]), BALL, TARGET)
  assert way.pushes
  assert way.point[0] == pytest.approx(SETTINGS.overshoot, abs=0.05) and way.point[1] < 0


def test_before_the_ball_it_goes_behind_it_with_the_ball_s_clearance():
  push = Push(Planner(_Room()), SETTINGS)
  robot = np.array([0.8, 0.0])
  way = push.way(robot, BALL, TARGET)
  assert not way.pushes
  assert np.linalg.norm(way.point - BALL) == pytest.approx(SETTINGS.behind)
  assert way.point[0] <= 0.05  # not on the target's side
  path = push.path(robot, BALL, way.point)
  near = np.linalg.norm(path[1:-2] - BALL, axis=1)
  assert near.min() > SETTINGS.clearance - 0.06  # a cell of the grid


def test_at_a_wall_it_pushes_from_where_a_robot_fits():
  planner = Planner(_WallBehind())
  way = Push(planner, SETTINGS).way(np.array([0.0, -1.0]), BALL, TARGET)
  assert planner.is_free(way.point) and not planner.is_free(np.array([-SETTINGS.behind, 0.0]))
  assert (BALL - way.point) @ TARGET >= -1e-6  # still not away from the target


def test_a_push_ends_at_twice_the_offset_at_which_it_begins():
  aside = np.array([-0.3, 1.5 * SETTINGS.lane])
  settings = PushSettings(stickiness=0.0, headings=4)  # straight, or aside
  push = Push(Planner(_Room()), settings)
  assert not push.way(aside, BALL, TARGET).pushes
  assert push.way(np.array([-0.3, 0.0]), BALL, TARGET).pushes
  assert push.way(aside, BALL, TARGET).pushes
