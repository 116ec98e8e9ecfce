"""Rotations against their definitions and MuJoCo's."""

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry import rotations

angles = st.floats(-3.1, 3.1)


@st.composite
def directions(draw):
  vector = np.array([draw(st.floats(-1, 1)) for _ in range(3)])
  length = np.linalg.norm(vector)
  assume(length > 1e-3)
  return vector / length


def is_rotation(matrix):
  np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
  assert np.linalg.det(matrix) == pytest.approx(1.0)


@given(start=directions(), end=directions())
def test_shortest_rotation(start, end):
  assume(start @ end > -0.999)
  found = rotations.shortest_rotation(start, end)
  is_rotation(found)
  np.testing.assert_allclose(found @ start, end, atol=1e-12)
  angle = np.arccos(np.clip(start @ end, -1, 1))
  assert np.linalg.norm(Rotation.from_matrix(found).as_rotvec()) == pytest.approx(angle, abs=1e-6)


@given(start=directions())
def test_opposite_directions(start):
  found = rotations.shortest_rotation(start, -start)
  is_rotation(found)
  np.testing.assert_allclose(found @ start, -start, atol=1e-9)


def test_half_turn_about_a_given_axis():
  axis = np.array([0.6, 0.8, 0.0])
  up = np.array([0.0, 0.0, 1.0])
  found = rotations.shortest_rotation(-up, up, half_turn_axis=axis)
  is_rotation(found)
  np.testing.assert_allclose(found @ axis, axis, atol=1e-12)
  np.testing.assert_allclose(found @ -up, up, atol=1e-12)


@given(up=directions())
def test_up_is_turned_to_z(up):
  np.testing.assert_allclose(rotations.rotation_to_up(up) @ up, [0, 0, 1], atol=1e-7)


@pytest.mark.parametrize("tilt", [1e-3, 2e-6, 1e-7, 1e-9])
def test_nearly_opposite_directions(tilt):
  start = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
  found = rotations.rotation_to_up(start)
  is_rotation(found)
  np.testing.assert_allclose(found @ start, [0, 0, 1], atol=2e-9)


@given(yaw=angles)
def test_yaw(yaw):
  matrix = rotations.yaw_matrix(yaw)
  np.testing.assert_allclose(matrix @ [1, 0, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-12)
  quaternion = rotations.yaw_quaternion(yaw)
  np.testing.assert_allclose(rotations.matrix_from_quaternion(quaternion), matrix, atol=1e-12)
  assert rotations.yaw_of(matrix) == pytest.approx(yaw)


@given(axis=directions(), angle=angles)
def test_quaternions_are_those_of_mujoco(axis, angle):
  expected, matrix = np.zeros(4), np.zeros(9)
  mujoco.mju_axisAngle2Quat(expected, axis, angle)
  mujoco.mju_quat2Mat(matrix, expected)
  found = rotations.quaternion_from_rotvec(axis * angle)
  np.testing.assert_allclose(found * np.sign(found @ expected), expected, atol=1e-9)
  for turned in (
    rotations.matrix_from_rotvec(axis * angle),
    rotations.matrix_from_quaternion(expected),
    rotations.matrix_from_quaternion(rotations.quaternion_from_matrix(matrix.reshape(3, 3))),
  ):
    np.testing.assert_allclose(turned, matrix.reshape(3, 3), atol=1e-9)
  start, product = np.array([0.5, 0.5, -0.5, 0.5]), np.zeros(4)
  mujoco.mju_mulQuat(product, expected, start)
  found = rotations.rotate_quaternion(axis * angle, start)
  np.testing.assert_allclose(found * np.sign(found @ product), product, atol=1e-9)


@given(forward=directions())
def test_camera_axes_are_upright(forward):
  assume(abs(forward[2]) < 0.99)
  axes = rotations.camera_axes(np.stack([forward, [1.0, 0, 0]]))
  for one in axes:
    is_rotation(one)
    assert one[2, 0] == pytest.approx(0.0) and one[2, 1] < 0  # x is level, y points down
  np.testing.assert_allclose(axes[0][:, 2], forward)


def test_pose_of_a_mujoco_camera():
  spec = mujoco.MjSpec()
  spec.worldbody.add_camera(name="eye", pos=[1, 2, 3], quat=[1, 0, 0, 0])  # looks down, y up
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  pose = rotations.pose_of_mujoco_camera(data.cam_xpos[0], data.cam_xmat[0])
  np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])
  np.testing.assert_allclose(pose[:3, :3] @ [0, 0, 1], [0, 0, -1])  # forward
  np.testing.assert_allclose(pose[:3, :3] @ [0, 1, 0], [0, -1, 0])  # down in the picture


def test_level_up_of_cameras_that_all_look_down():
  rng = np.random.default_rng(0)
  turn = Rotation.random(random_state=0).as_matrix()
  for arc, most in ((2 * np.pi, 1.0), (np.pi, 2.0), (np.pi / 2, 5.0)):
    poses = np.tile(np.eye(4), (40, 1, 1))
    for pose, heading in zip(poses, np.linspace(0, arc, 40, endpoint=False), strict=True):
      level = np.cos(np.radians(35))
      forward = np.array(
        [level * np.cos(heading), level * np.sin(heading), -np.sin(np.radians(35))]
      )
      roll = Rotation.from_rotvec([0, 0, rng.normal(0, np.radians(3))]).as_matrix()
      pose[:3, :3] = turn @ rotations.camera_axes(forward) @ roll
    poses[::10, :3, :3] = poses[::10, :3, :3] @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # held upright
    found = rotations.level_up(poses, -poses[:, :3, 1].mean(0))
    assert np.degrees(np.arccos(found @ turn[:, 2])) < most
    assert np.linalg.norm(found) == pytest.approx(1)
