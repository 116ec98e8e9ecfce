"""Reward terms against values worked out by hand from the paper's formulas."""

import numpy as np
import pytest

from nerf2real.suite.tasks import rewards


def _rotation(axis, angle):
  x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
  skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
  return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def test_turn_penalises_speed_in_both_directions():
  assert [rewards.turn(w) for w in (0.0, 3.14, 3.15, -3.14, -3.15)] == [0, 0, -1, 0, -1]


def test_pose_is_a_penalty():
  # Errors over ranges: 0.1 / 0.5 = 0.2 and -0.2 / 1 = -0.2; root of mean of squares 0.2.
  value = rewards.pose(
    np.array([0.1, 0.0]), reference=np.array([0.0, 0.2]), joint_range=np.array([0.5, 1.0])
  )
  assert value == pytest.approx(-0.2)
  # One joint of twenty off by its whole range: -sqrt(1 / 20).
  joints = np.zeros(20)
  joints[3] = 2.0
  assert rewards.pose(joints, np.zeros(20), np.full(20, 2.0)) == pytest.approx(-(0.05**0.5))


@pytest.mark.parametrize(
  ("speed", "expected"), [(0.3, 1.0), (0.0, 0.0), (-0.3, -1.0), (0.45, 0.5), (0.15, 0.5)]
)
def test_speed(speed, expected):
  assert rewards.speed(speed) == pytest.approx(expected)


def test_navigate_sparse_is_strict():
  assert rewards.navigate_sparse(np.array([0.15, 0.19])) == 1.0  # 0.2421 m
  assert rewards.navigate_sparse(np.array([0.25, 0.0])) == 0.0
  assert rewards.navigate_sparse(np.array([0.2, 0.2])) == 0.0  # 0.283 m


def test_navigate():
  goal = np.array([2.0, 0.0])
  assert rewards.navigate(np.array([0.3, 0.0]), goal) == pytest.approx(1.0)
  # Sideways: the error is 0.3 sqrt(2), so 1 - sqrt(2).
  assert rewards.navigate(np.array([0.0, 0.3]), goal) == pytest.approx(1 - 2**0.5)
  # Backwards: error 0.6, so -1. Standing: error 0.3, so 0.
  assert rewards.navigate(np.array([-0.3, 0.0, 9.0]), goal) == pytest.approx(-1.0)
  assert rewards.navigate(np.zeros(2), np.array([-1.0, 1.0])) == pytest.approx(0.0)
  assert rewards.navigate(np.zeros(2), np.zeros(2)) == pytest.approx(1.0)


def test_rho():
  assert rewards.rho(0.0, 0.0) == pytest.approx(1.0)
  assert rewards.rho(1.0, 0.0) == pytest.approx(0.36787944)  # e^-1
  assert rewards.rho(1.0, 1.0) == pytest.approx(0.13533528)  # e^-2: moving away earns nothing
  # Approaching at 1 m/s: e^-2 + (1 - e^-1)^2 = 0.13533528 + 0.39957640.
  assert rewards.rho(1.0, -1.0) == pytest.approx(0.53491168)
  # Far away and fast towards it: close to 1.
  assert rewards.rho(5.0, -3.0) == pytest.approx(1.0, abs=2e-4)


def test_ball():
  # 0.36787944 + (1 - 0.36787944) * 0.53491168 / 2 = 0.53694377.
  value = rewards.ball(1.0, 0.0, ball_distance=1.0, ball_rate=-1.0)
  assert value == pytest.approx(0.53694377, abs=1e-7)


def test_navigation_total():
  terms = rewards.navigation_task(
    4.0,
    np.array([0.3, 0.0]),
    goal=np.array([0.1, 0.0]),
    joints=np.array([0.5]),
    reference=np.array([0.0]),
    joint_range=np.array([1.0]),
  )
  # -1 + 0.5 * 1 + 0.5 * (-0.5) + 1 + 0.25 * 1 = 0.5.
  assert terms == pytest.approx(
    {"turn": -1, "speed": 1, "pose": -0.5, "navigate_sparse": 1, "navigate": 1, "total": 0.5}
  )


def test_ball_total_and_rates():
  terms = rewards.ball_task(
    0.0,
    np.array([0.0, 0.0]),
    goal_from_ball=np.array([0.0, 1.0]),
    ball_from_robot=np.array([1.0, 0.0, 5.0]),
    ball_velocity=np.array([0.0, 0.0, 3.0]),
    robot_velocity=np.array([1.0, 2.0, 0.0]),
    joints=np.array([0.0]),
    reference=np.array([0.0]),
    joint_range=np.array([1.0]),
  )
  # The robot closes on the ball at 1 m/s (the sideways 2 m/s do not count): as in test_ball.
  assert terms["ball"] == pytest.approx(0.53694377, abs=1e-7)
  assert terms["total"] == pytest.approx(0.53694377, abs=1e-7)


def test_wrong_terms_are_named():
  with pytest.raises(ValueError, match="expected"):
    rewards.combine({"turn": 0.0}, rewards.BALL_WEIGHTS)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.2, 3.0])
def test_gravity_aligned_frame_is_the_smallest_rotation(tilt):
  torso = _rotation([1, -2, 0], tilt) @ _rotation([0, 0, 1], 0.7)
  aligned = rewards.gravity_aligned_frame(torso)
  np.testing.assert_allclose(aligned.T @ aligned, np.eye(3), atol=1e-12)
  np.testing.assert_allclose(aligned[:, 2], [0, 0, 1], atol=1e-12)
  # The tilt's axis is horizontal, so undoing it leaves the pure heading.
  np.testing.assert_allclose(aligned, _rotation([0, 0, 1], 0.7), atol=1e-12)


def test_gravity_aligned_frame_upside_down_keeps_x():
  aligned = rewards.gravity_aligned_frame(_rotation([1, 0, 0], np.pi))
  np.testing.assert_allclose(aligned, np.eye(3), atol=1e-12)


def test_yaw_rate_is_that_of_the_aligned_frame():
  torso = _rotation([1, -2, 0.5], 0.9) @ _rotation([0, 0, 1], 0.7)
  velocity = np.array([0.8, -1.1, 0.6])
  step = 1e-6
  moved = _rotation(velocity, np.linalg.norm(velocity) * step) @ torso
  before, after = rewards.gravity_aligned_frame(torso), rewards.gravity_aligned_frame(moved)
  turned = np.arctan2(after[1, 0], after[0, 0]) - np.arctan2(before[1, 0], before[0, 0])
  assert rewards.yaw_rate(torso, velocity) == pytest.approx(turned / step, abs=1e-5)
  assert abs(rewards.yaw_rate(torso, velocity) - velocity[2]) > 0.02
