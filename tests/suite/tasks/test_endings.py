"""Endings, success and rewards of the two tasks."""

import mujoco
import numpy as np
import pytest
from dm_env import StepType

from nerf2real.suite.pose import Pose
from nerf2real.suite.tasks import rewards


def _step_until_end(environment, action, limit=200):
  for _ in range(limit):
    timestep = environment.step(action)
    if timestep.last():
      return timestep
  raise AssertionError("the episode did not end")


@pytest.mark.parametrize("name", ["nav", "ball"])
def test_a_fall_ends_the_episode(name, request):
  environment = request.getfixturevalue(name)
  far = {"ball_xy": (0.0, 1.0)} if name == "ball" else {}
  environment.task.set_start(Pose(-1.0, 0.0, 0.0), **far)
  environment.reset()
  environment.physics.data.ptr.qvel[4] = 8.0  # a somersault
  last = _step_until_end(environment, environment.task.standing_action)
  assert last.discount == 0.0 and environment.task.outcome.ending == "fall"
  assert environment.step(environment.task.standing_action).step_type == StepType.FIRST
  assert environment.task.outcome.ending is None


def test_touching_the_room_ends_navigation_unless_it_is_a_foot(nav):
  # The table's edge is at x = 2, 0.5 m high: the robot's chest against it, then its toes
  # against a sill of 3 cm.
  nav.task.set_start(Pose(1.97, 1.8, 0.0))
  nav.reset()
  last = _step_until_end(nav, nav.task.standing_action, 3)
  assert last.discount == 0.0 and nav.task.outcome.ending == "collision"
  nav.task.set_start(Pose(0.0, 0.0, 0.0))
  nav.reset()
  toes = float(nav.physics.named.data.geom_xpos["op3/l_ank_roll_link_0", "x"]) + 0.0635
  nav.task.set_start(Pose(2.0 - toes + 0.002, 0.0, 0.0))
  nav.reset()
  nav.step(nav.task.standing_action)
  model, pairs = nav.physics.model.ptr, nav.physics.data.ptr.contact.geom
  touched = {
    model.body(int(model.geom_bodyid[g])).name
    for pair in pairs
    for g in pair
    if any(model.geom_group[other] == 3 for other in pair) and model.geom_group[g] != 3
  }
  assert touched and touched <= {"op3/l_ank_roll_link", "op3/r_ank_roll_link"}
  assert nav.task.outcome.ending is None


def test_navigation_succeeds_within_25_cm_and_rewards_it(nav):
  goal = nav.task.goals[1]
  for distance, success in ((0.27, False), (0.23, True)):
    nav.task.set_start(Pose(goal[0] - distance, goal[1], 0.0), goal_index=1)
    observation = nav.reset().observation
    np.testing.assert_allclose(observation["goal"], goal, atol=1e-6)
    np.testing.assert_allclose(observation["privileged/goal"], [distance, 0], atol=1e-3)
    nav.step(nav.task.standing_action)
    assert nav.task.outcome.success is success
    assert nav.task.reward_terms["navigate_sparse"] == float(success)
  assert nav.task.outcome.success_time == pytest.approx(0.025)


def test_reward_is_the_weighted_sum_of_the_logged_terms(nav, ball):
  for environment, weights in (
    (nav, {"turn": 1, "speed": 0.5, "pose": 0.5, "navigate_sparse": 1, "navigate": 0.25}),
    (ball, {"turn": 1, "speed": 0.5, "pose": 0.5, "ball": 1}),
  ):
    environment.reset()
    reward = environment.step(environment.task.standing_action).reward
    terms = dict(environment.task.reward_terms)
    assert reward == terms.pop("total")
    assert terms.keys() == weights.keys()
    assert reward == pytest.approx(sum(weights[k] * v for k, v in terms.items()))
    assert terms["pose"] < 0


def test_feet_velocity_is_that_of_the_whole_robot_sliding(nav):
  nav.task.set_start(Pose(-1.0, 0.0, 1.1))
  nav.reset()
  data = nav.physics.data.ptr
  data.qvel[:2] = 0.3 * np.cos(1.1), 0.3 * np.sin(1.1)
  mujoco.mj_forward(nav.physics.model.ptr, data)
  state = nav.task._indices.read()
  np.testing.assert_allclose(state.feet_velocity, [0.3, 0, 0], atol=2e-3)
  assert rewards.speed(state.feet_velocity[0]) == pytest.approx(1.0, abs=0.01)
