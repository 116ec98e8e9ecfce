"""Ball pushing: where the ball is in the data, what a picture shows of it, its losses."""

import dataclasses

import jax
import numpy as np
import pytest

from nerf2real.agents.distill import dataset, settings
from nerf2real.agents.distill import teacher as teachers
from nerf2real.agents.distill.collecting import episodes
from nerf2real.agents.distill.learning import losses, student
from nerf2real.agents.distill.learning.updates import make_updates
from nerf2real.agents.dmpo.specs import BALL, FlatObservation
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from tests.agents.distill.test_student import LAYOUT, TINY, _batch

WITH_BALL = dataclasses.replace(
  LAYOUT, privileged_names=(BALL, *LAYOUT.privileged_names), privileged_sizes=(3, 3, 9)
)


def test_the_layout_knows_where_the_ball_is():
  privileged = np.array([7.0, 8.0, 9.0, *np.zeros(12)], np.float32)
  flat = FlatObservation(None, np.zeros(5, np.float32), privileged)
  assert episodes.ball_of(WITH_BALL, flat) == pytest.approx([7.0, 8.0])
  assert episodes.ball_of(LAYOUT, flat) is None
  assert WITH_BALL.pose_columns == (3, 6) and LAYOUT.pose_columns == (0, 3)
  assert "ball" in dataset.fields(WITH_BALL) and "ball" not in dataset.fields(LAYOUT)


def test_a_ball_from_the_robot_and_in_its_picture():
  joints = np.zeros((5, 20))
  joints[-1, constants.JOINT_NAMES.index("head_pan")] = 0.5
  observation = {"joint_positions": joints}
  found = episodes.relative_ball(observation, Pose(1.0, 1.0, np.pi / 2), np.array([1.0, 3.0]))
  assert found == pytest.approx([2.0, 0.0, 0.5])  # straight ahead; the head looks to the left of it
  target, seen = losses.ball_target_of_picture(np.asarray(found))
  assert target == pytest.approx([np.cos(0.5), -np.sin(0.5)], abs=1e-6)  # 2 m, in units of 2 m
  assert seen == 0  # 0.5 rad aside: the picture is 0.49 rad wide to each side
  for pan, expected in ((0.3, 1.0), (-0.3, 1.0), (-2.0, 0.0), (3.0, 0.0)):
    assert losses.ball_target_of_picture(np.array([2.0, 0.0, pan]))[1] == expected
  assert episodes.relative_ball(observation, Pose(0.0, 0.0, 0.0), None) is None


def test_a_ball_is_as_far_from_a_believed_pose_as_from_the_true_one():
  observation = {"joint_positions": np.zeros((5, 20))}
  ball, truth, belief = np.array([1.0, 3.0]), Pose(0.8, 1.0, 1.2), Pose(1.5, 0.4, -0.7)
  relative = episodes.relative_ball(observation, truth, ball)
  believed = episodes.believed_ball(relative, belief)
  assert episodes.relative_ball(observation, belief, believed) == pytest.approx(relative)
  assert np.hypot(*(believed - ball)) > 0.5
  assert episodes.believed_ball(relative, truth) == pytest.approx(ball)


def test_a_picture_shows_where_the_camera_looks_not_where_the_torso_does():
  pose = np.array([[1.0, 2.0, 3.0]])
  ball = np.array([[0.5, 0.1, -0.7]])
  assert losses.camera_pose(pose, ball)[0] == pytest.approx([1.0, 2.0, 2.3])
  assert losses.camera_pose(pose, None) is pose


class _Certain:
  """A policy whose belief is one place."""

  def belief(self, embedding):
    return np.array([0.0, 5.0]), np.array([[9.0, 9.0, 9.0], [1.0, 2.0, 0.8]]), np.ones((2, 3))


def test_the_robots_heading_is_the_beliefs_less_the_heads_pan():
  found = episodes.likeliest_pose(_Certain(), np.zeros(3), pan=0.5)
  assert found == pytest.approx((1.0, 2.0, 0.3))


def test_an_encoder_learns_the_cameras_heading():
  """Of pictures that show the head's direction alone: the torso's could not be told."""
  updates = make_updates(TINY, WITH_BALL)
  state = updates.init(jax.random.PRNGKey(0))
  rng = np.random.default_rng(0)
  pan = rng.choice([-1.0, 1.0], 64)
  left = np.where(pan > 0, 255, 0)[:, None, None, None]
  flat = {
    "image": np.broadcast_to(left, (64, 12, 16, 3)).astype(np.uint8),
    "pose": np.zeros((64, 3), np.float32),
    "ball": np.stack([np.ones(64), np.zeros(64), pan], -1).astype(np.float32),
  }
  for _ in range(60):
    state, metrics = updates.encoder(state, flat, 3e-3)
  assert metrics["loss_encoder"] < 0.1  # a heading of 0 for all leaves 0.21


def test_only_balls_in_view_count_for_a_picture():
  predicted = np.zeros((2, 2), np.float32)
  target = np.array([[1.0, 0.5], [9.0, 9.0]], np.float32)
  assert losses.ball_loss(predicted, target, np.array([1.0, 0.0])) == pytest.approx(0.75)
  assert losses.ball_loss(predicted, target, np.zeros(2)) == 0


def test_a_students_heads_learn_the_balls_place():
  updates = make_updates(TINY, WITH_BALL)
  state = updates.init(jax.random.PRNGKey(0))
  assert {"pose", "ball"} <= set(state.student["encoder"])
  batch = _batch()
  batch["ball"] = np.random.default_rng(0).normal(0, 1, (2, 6, 3)).astype(np.float32)
  batch["ball"][..., 0] = np.abs(batch["ball"][..., 0])
  batch["ball"][..., 2] = 0.0
  flat = {n: batch[n].reshape(-1, *batch[n].shape[2:]) for n in ("image", "pose", "ball")}
  pictures, carried = [], student.initial_state(2, TINY.agent.network)
  for _ in range(40):
    state, metrics = updates.encoder(state, flat, 3e-3)
    pictures.append(float(metrics["loss_ball"]))
  assert pictures[-1] < 0.8 * pictures[0]
  batch["features"] = np.random.default_rng(3).normal(size=(2, 6, 8)).astype(np.float32)
  del batch["image"]
  unrolls = []
  for _ in range(40):
    state, _, metrics = updates.policy(state, batch, carried, 3e-3)
    unrolls.append(float(metrics["loss_ball"]))
  assert unrolls[-1] < 0.8 * unrolls[0]
  served = student.served_parameters(state.student, state.scales)
  assert not any("ball" in name for name in served)


def test_the_teacher_pushes_with_the_pan_of_ball_pushing():
  """The same pan [rad] is another action than in navigation: the limits differ."""
  from nerf2real.suite.gaits.floor import EmptyFloor

  teacher = teachers.make_teacher("ball", EmptyFloor())
  teacher.reset(Pose(0.0, 0.0, 0.0))
  observation = {
    "gyroscope": np.zeros((5, 3)),
    "gravity": np.tile([0.0, 0.0, -1.0], (5, 1)),
    "joint_positions": np.tile(constants.standing_targets(), (5, 1)),
    "previous_control": np.zeros((5, 20)),
  }
  pan = constants.JOINT_NAMES.index("head_pan")
  label = None
  for _ in range(60):  # the ball is ahead on the left, and in view
    observation["joint_positions"][-1, pan] = 0.9
    label = teacher.label(
      observation, goal=np.array([3.0, 3.0]), pose=Pose(0.0, 0.0, 0.0), ball=np.array([1.0, 1.0])
    )
    applied = observation["previous_control"][-1]
    observation["previous_control"][-1] = 0.8 * applied + 0.2 * label.action
  assert label is not None and np.abs(label.action).max() <= 1
  held = observation["previous_control"][-1, pan] * constants.BALL_PUSHING_HEAD_PAN
  assert held == pytest.approx(np.pi / 4, abs=0.05)
  assert label.command[1] > 0.5  # towards the ball's other side


def test_the_preset_is_for_the_ball():
  found = settings.preset("ball_push")
  assert found.environment == "suite:ball_push?light=true" and found.teacher == "ball"
  more = settings.preset("ball_push_on")
  assert (more.environment, more.views) == (found.environment, found.views) and found.views > 0
