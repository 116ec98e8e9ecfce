"""The walker: paths around matter, goals one after another, dead reckoning, the ball."""

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.scenes.geometry.free_space import FreeSpace
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.gaits.planner import Planner
from nerf2real.suite.gaits.walker import Walker
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import RandomisationSettings

QUIET = RandomisationSettings(pushes=False)
GOALS = ((0.6, 0.0), (0.6, 0.5), (0.0, 0.5), (-0.3, 0.0), (0.2, -0.3))


class WallWithDoor(FreeSpace):
  """A floor of 4 x 4 m with a wall at x = 0 that has a door at y in (1, 1.6)."""

  extent = (np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.0]))

  @property
  def free_space(self):
    return self

  def sample(self, rng, count):
    return rng.uniform([-2, -2, -np.pi], [-0.2, 2, np.pi], (count, 3))

  def is_reachable(self, points):
    xy = np.asarray(points)
    wall = np.abs(xy[..., 0]) < 0.15
    door = (xy[..., 1] > 1.0) & (xy[..., 1] < 1.6)
    return ~wall | door


def test_path_leads_through_the_door():
  planner = Planner(WallWithDoor())
  path = planner.path(np.array([-1.0, -1.0]), np.array([1.0, -1.0]))
  assert path[0] == pytest.approx([-1, -1]) and path[-1] == pytest.approx([1, -1])
  assert WallWithDoor().is_reachable(path).all()
  crossing = path[np.abs(path[:, 0]) < 0.1]
  assert (np.abs(crossing[:, 1] - 1.3) < 0.15).all()  # in the middle of the door, for comfort
  assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.08


def _environment(seconds):
  environment = suite.load(
    "nerf_nav",
    scene=EmptyFloor(),
    image_size=None,
    random=1,
    time_limit=seconds,
    randomisation=QUIET,
    privileged=False,
  )
  environment.task.set_start(Pose(0.0, 0.0, 0.3))
  return environment


def _pose(task):
  return Pose(float(task.state.position[0]), float(task.state.position[1]), task.state.yaw)


def test_reaches_five_goals_one_after_another():
  environment = _environment(40.0)
  timestep, task = environment.reset(), environment.task
  walker = Walker(task.scene)
  walker.reset(_pose(task))
  reached = []
  for goal in GOALS:
    while not timestep.last() and np.linalg.norm(task.state.position[:2] - goal) > 0.15:
      timestep = environment.step(walker.act(timestep.observation, goal=goal, pose=_pose(task)))
    reached.append(not timestep.last())
  assert reached == [True] * 5 and task.ending is None


def test_dead_reckoning_knows_roughly_where_it_is():
  environment = _environment(9.0)
  timestep, task = environment.reset(), environment.task
  walker = Walker(task.scene)
  walker.reset(_pose(task))
  while not timestep.last():
    timestep = environment.step(walker.act(timestep.observation, goal=np.array([0.8, 0.8])))
  travelled = np.linalg.norm(task.state.position[:2])
  assert task.ending is None and travelled > 0.7
  assert np.linalg.norm(walker.pose.xy - task.state.position[:2]) < 0.35 * travelled


def test_walks_around_the_ball_before_it_pushes():
  walker = Walker(EmptyFloor())
  ball, target = np.array([0.0, 0.0]), np.array([1.0, 0.0])
  walker.reset(Pose(-0.3, 0.0, 0.0))  # behind it, on the line
  command = walker._push(ball, target)
  assert command.forward > 0.9 and abs(command.turn) < 0.1
  walker.reset(Pose(0.5, 0.0, np.pi))  # between ball and target, looking at the ball
  heading = walker._push(ball, target)
  assert abs(heading.turn) > 0.3  # not straight into it
  walker.pose = Pose(-0.3, 0.2, 0.0)  # behind it, beside the line: not yet
  assert walker._push(ball, target).turn < -0.3


def test_stands_at_the_goal():
  walker = Walker(EmptyFloor())
  walker.reset(Pose(0.0, 0.0, 0.0))
  assert not walker._walk_to(np.array([0.05, 0.0])).step
  assert walker._walk_to(np.array([1.0, 0.0])).step
