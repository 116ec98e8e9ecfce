"""Losses of a student by arrays computed by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from nerf2real.agents.distill.learning import losses


def test_pose_targets_and_their_errors():
  pose = jnp.array([[2.0, -1.0, np.pi / 2]])
  target = losses.pose_target(pose)
  assert target[0] == pytest.approx([1.0, -0.5, 0.0, 1.0], abs=1e-6)
  assert float(losses.pose_loss(target + 0.25, pose)) == pytest.approx(0.25)
  predicted = jnp.array([[1.3, -0.1, -1.0, 0.0]])  # 0.6 m and 0.8 m off, facing backwards
  distance, turn = losses.pose_errors(predicted, pose)
  assert float(distance[0]) == pytest.approx(1.0)
  assert float(turn[0]) == pytest.approx(np.pi / 2)


def test_a_joint_that_moves_little_counts_as_much():
  labels = jnp.zeros((1, 2))
  spread = jnp.array([1.0, 0.1])
  weights = jnp.ones(1)
  large = losses.action_loss(jnp.array([[0.5, 0.0]]), labels, spread=spread, weights=weights)
  small = losses.action_loss(jnp.array([[0.0, 0.05]]), labels, spread=spread, weights=weights)
  assert float(large) == pytest.approx(0.5 * 0.5**2 / 2)  # mean over two joints
  assert float(small) == pytest.approx(float(large))
  far = losses.action_loss(jnp.array([[3.0, 0.0]]), labels, spread=spread, weights=weights)
  assert float(far) == pytest.approx((3.0 - 0.5) / 2)  # beyond one spread it grows linearly


def test_frames_near_the_goal_count_nothing_and_turning_counts_more():
  command = jnp.array([[1.0, 0.0], [0.0, -1.0], [0.5, 0.5], [jnp.nan, jnp.nan]])
  distance = jnp.array([1.0, 1.0, 0.1, 1.0])
  weights = losses.frame_weights(command, distance, turn_emphasis=2.0, blind_radius=0.13)
  assert weights == pytest.approx([1.0, 3.0, 0.0, 1.0])
  actions = jnp.array([[1.0], [2.0], [100.0], [1.0]])
  found = losses.action_loss(actions, jnp.zeros((4, 1)), spread=jnp.ones(1), weights=weights)
  assert float(found) == pytest.approx((0.5 + 3.0 * 1.5 + 0.5) / 5.0)


def test_a_teacher_without_commands_gives_no_command_loss():
  command = jnp.array([[jnp.nan, jnp.nan], [1.0, -1.0]])
  found = losses.command_loss(jnp.zeros((2, 2)), command, jnp.ones(2))
  assert float(found) == pytest.approx(1.0)
  assert float(losses.command_loss(jnp.zeros((1, 2)), command[:1], jnp.ones(1))) == 0.0
