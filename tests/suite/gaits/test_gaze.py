"""The head's part of pushing a ball: what is seen, where it points, how it searches."""

import mujoco
import numpy as np
import pytest

from nerf2real.suite.gaits.gaze import Gaze, depression, is_seen, view_of
from nerf2real.suite.gaits.walk import Command

WALK = Command(forward=1.0, turn=0.2)


def test_where_a_ball_is_from_the_robot():
  view = view_of((1.0, 2.0, np.pi / 2), np.array([0.0, 2.0]))
  assert view == pytest.approx((np.pi / 2, 1.0))  # a quarter turn to the left
  behind = view_of((0.0, 0.0, 3.0), np.array([-2.0, 0.0]))
  assert behind.bearing == pytest.approx(np.pi - 3.0)  # across the half turn


@pytest.mark.parametrize("distance", [0.4, 1.0, 2.5])
def test_a_head_that_points_at_the_ball_sees_it_and_one_that_points_away_does_not(distance):
  ball = view_of((0.0, 0.0, 0.0), distance * np.array([np.cos(0.7), np.sin(0.7)]))
  tilt = 0.08 - depression(distance)
  assert is_seen(ball, pan=0.7, tilt=tilt)
  assert is_seen(ball, pan=0.4, tilt=tilt)
  assert not is_seen(ball, pan=-0.1, tilt=tilt)
  assert not is_seen(ball, pan=0.7, tilt=tilt - 0.9)


def _step(gaze, heads, ball):
  """Moves an ideal head a little towards its target, as in a control step.

  Args:
    heads: Pan and tilt of the last two steps [2, 2] [rad].
  """
  (pan, tilt), moved = heads[-1], heads[-1, 0] - heads[0, 0]
  view = view_of((0.0, 0.0, 0.0), ball)
  command = gaze.apply(WALK, view, pan=pan, tilt=tilt, moved=moved)
  head = heads[-1] + np.clip(np.array(command.head) - heads[-1], -0.06, 0.06)
  return command, np.vstack([heads[1:], head])


def _heads(pan, tilt):
  return np.tile([pan, tilt], (2, 1))


@pytest.mark.parametrize("bearing", [0.0, 1.5, -1.5, 2.6, -2.6])
def test_a_search_finds_the_ball_and_the_head_stays_on_it(bearing):
  ball = 1.2 * np.array([np.cos(bearing), np.sin(bearing)])
  gaze, head, searching = Gaze(), _heads(0.0, -0.47), 0
  for _ in range(400):
    command, head = _step(gaze, head, ball)
    if gaze.searches:
      assert command.turn == 1 and command.forward == 0
      searching += 1
  assert searching * 0.025 < 5.0 and not gaze.searches
  assert command == Command(forward=1.0, turn=0.2, head=command.head)
  assert head[-1, 0] == pytest.approx(np.clip(bearing, -2.3, 2.3), abs=0.02)
  assert head[-1, 1] == pytest.approx(0.33 - depression(1.2), abs=0.02)


@pytest.mark.parametrize("distance", [0.22, 0.3, 0.5, 1.0])
def test_the_picture_of_a_held_ball_reaches_beyond_the_floor_at_the_feet(distance):
  ball = view_of((0.0, 0.0, 0.0), np.array([distance, 0.0]))
  gaze, head = Gaze(), _heads(0.0, -0.47)
  for _ in range(100):
    _, head = _step(gaze, head, np.array([distance, 0.0]))
  tilt = np.clip(head[-1, 1], -0.79, -0.157)
  assert is_seen(ball, pan=0.0, tilt=tilt)
  top = tilt - 0.08 + np.deg2rad(43.3) / 2  # of the picture, from the horizontal
  reach = np.inf if top >= 0 else 0.45 / np.tan(-top)
  assert reach > (0.9 if distance < 0.25 else 2.0)  # m: else the floor ends where the picture does


def test_a_ball_behind_the_robot_makes_it_turn_on_the_spot_all_the_time():
  gaze, head = Gaze(), _heads(0.0, -0.3)
  for _ in range(400):
    command, head = _step(gaze, head, np.array([-1.0, 0.0]))
    assert command == Command(turn=1.0, head=command.head)


@pytest.mark.parametrize("pan", [-1.4, 0.6])
def test_a_sweep_goes_on_where_the_head_moves_and_at_rest_to_the_farther_side(pan):
  behind = view_of((0.0, 0.0, 0.0), np.array([-1.0, 0.0]))
  for moved, onward in ((0.02, 1), (-0.02, -1), (0.0, -np.sign(pan)), (0.002, -np.sign(pan))):
    command = Gaze().apply(WALK, behind, pan=pan, tilt=-0.3, moved=moved)
    assert command.head[0] == pytest.approx(pan + 0.4 * onward)


def test_a_slow_sweep_goes_through_the_middle():
  behind, pan, moved = view_of((0.0, 0.0, 0.0), np.array([-1.0, 0.0])), 0.5, 0.0
  for _ in range(400):  # a head that does a hundredth of what it is told
    command = Gaze().apply(WALK, behind, pan=pan, tilt=-0.3, moved=moved)
    moved = 0.01 * (command.head[0] - pan)
    pan += moved
  assert pan < -0.8


def test_a_ball_that_is_out_of_sight_for_a_moment_is_not_lost():
  gaze, head = Gaze(), _heads(0.0, -0.2)
  _, head = _step(gaze, head, np.array([1.0, 0.0]))
  assert not gaze.searches
  aside = np.array([np.cos(1.2), np.sin(1.2)])
  for step in range(100):
    command = gaze.apply(WALK, view_of((0.0, 0.0, 0.0), aside), pan=-0.5, tilt=-0.2, moved=0.0)
    assert gaze.searches == (step >= 80)  # 2 s
  assert command.forward == 0
  gaze.reset()
  assert gaze.searches


def test_the_cameras_angles_are_those_of_the_robot():
  """The picture's middle, of the simulated robot's head, passes through the ball's centre."""
  from nerf2real import suite
  from nerf2real.suite.gaits.floor import EmptyFloor
  from nerf2real.suite.op3 import constants
  from nerf2real.suite.pose import Pose

  environment = suite.load("nerf_nav", scene=EmptyFloor(), image_size=None, random=0)
  environment.task.set_start(Pose(0.0, 0.0, 0.0))
  environment.reset()
  model, data = environment.physics.model.ptr, environment.physics.data.ptr
  ball = np.array([0.9, 0.4])
  view = view_of((0.0, 0.0, 0.0), ball)
  lower, upper = constants.joint_limits()
  for name, angle in (("head_pan", view.bearing), ("head_tilt", -depression(view.distance))):
    index = constants.JOINT_NAMES.index(name)
    assert lower[index] < angle < upper[index]
    joint = next(i for i in range(model.njnt) if model.joint(i).name.endswith(name))
    data.qpos[model.jnt_qposadr[joint]] = angle
  mujoco.mj_kinematics(model, data)
  mujoco.mj_camlight(model, data)
  camera = next(i for i in range(model.ncam) if "head" in model.camera(i).name)
  look = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
  to_ball = np.array([*ball, 0.12]) - data.cam_xpos[camera]
  angle = np.arccos(look @ to_ball / np.linalg.norm(to_ball))
  assert angle < 0.08  # the view is 0.76 rad high


@pytest.mark.parametrize("distance", [0.25, 0.32, 0.4, 1.0, 2.5])
def test_sweeps_to_either_side_show_the_middle_of_balls_near_and_far(distance):
  """A ball of which a search shows a sliver alone is not found by a policy that has to see it."""
  behind = view_of((0.0, 0.0, 0.0), np.array([-distance, 0.0]))
  above = []
  for moved in (0.05, -0.05):
    command = Gaze().apply(WALK, behind, pan=0.3, tilt=-0.3, moved=moved)
    assert np.sign(command.head[0] - 0.3) == np.sign(moved)
    above.append(-depression(distance) - (command.head[1] - 0.08))
  assert min(np.abs(above)) < np.deg2rad(43.3) / 2
