"""Tests of the unit frame: upright, unique, with the walls along its axes."""

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.unit_frame import mean_up, unit_from_source
from tests.scenes import synthetic_capture as synthetic


def test_unit_frame_is_upright_and_holds_points_and_cameras():
  generator = np.random.default_rng(1)
  turn = cv2.Rodrigues(np.array([0.7, -0.4, 1.1]))[0]
  move = Similarity(3.7, turn, np.array([5.0, -2.0, 9.0]))
  poses = synthetic.walk(20)
  points = generator.uniform([0, 0, 0], [3, 3, 3], (5000, 3))
  points[:50] *= 40  # outliers
  unit = unit_from_source(move.apply_pose(poses), move.apply(points))
  cameras = unit.apply_pose(move.apply_pose(poses))
  np.testing.assert_allclose(mean_up(cameras), [0, 0, 1], atol=1e-9)
  inside = np.abs(unit.apply(move.apply(points))).max(axis=1) <= 1
  assert 0.975 <= inside.mean() <= 1
  assert np.abs(cameras[:, :3, 3]).max() < 1
  # It does not depend on the source's frame.
  same_frame(unit @ move, unit_from_source(poses, points))


def same_frame(found, expected, *, tolerance=1e-8):
  assert found.scale == pytest.approx(expected.scale, rel=tolerance)
  np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
  np.testing.assert_allclose(found.translation, expected.translation, atol=tolerance)


def square_rooms():
  """Points and poses whose box is as small in every quarter turn, in frames of all directions."""
  generator = np.random.default_rng(3)
  quarter = generator.uniform([-2, -2, 0], [2, 2, 2.5], (1000, 3))
  turns = [cv2.Rodrigues(np.array([0, 0, k * np.pi / 2]))[0] for k in range(4)]
  points = np.concatenate([quarter @ turn.T for turn in turns])
  for target in ([2, 0, 1.0], [2, 2, 1.0], [0.3, 1.9, 0.5]):  # along a wall, into a corner, else
    views = [synthetic.look_at(np.array([x, 0.1, 1.0]), np.array(target)) for x in (0, 0.3, 0.9)]
    yield np.stack(views), points


@pytest.mark.parametrize("seed", range(4))
def test_unit_frame_is_unique(seed):
  """Noise of a billionth, another order of the points and another source frame change nothing."""
  generator = np.random.default_rng(seed)
  for poses, points in square_rooms():
    expected = unit_from_source(poses, points)
    noise = 1e-9 * generator.standard_normal(points.shape)
    shaken = (points + noise)[generator.permutation(len(points))]
    same_frame(unit_from_source(poses, shaken), expected)
    turn = cv2.Rodrigues(generator.uniform(-3, 3, 3))[0]
    source = Similarity(generator.uniform(0.1, 9), turn, generator.uniform(-5, 5, 3))
    same_frame(unit_from_source(source.apply_pose(poses), source.apply(shaken)) @ source, expected)


def test_a_frame_found_again_in_its_own_frame_is_the_same():
  for poses, points in square_rooms():
    unit = unit_from_source(poses, points)
    again = unit_from_source(unit.apply_pose(poses), unit.apply(points))
    same_frame(again, Similarity(1.0, np.eye(3), np.zeros(3)))


def test_walls_end_up_along_the_axes():
  generator = np.random.default_rng(2)
  points = generator.uniform([-2.5, -2, 0], [2.5, 2, 2.5], (4000, 3))
  poses = np.stack(
    [synthetic.look_at(np.array([0.5, y, 1.0]), np.array([2, 1, 1.0])) for y in (0, 0.5)]
  )
  unit = unit_from_source(poses, points @ cv2.Rodrigues(np.array([0, 0, 0.6]))[0].T)
  extent = np.ptp(unit.apply(points @ cv2.Rodrigues(np.array([0, 0, 0.6]))[0].T), axis=0)
  assert sorted(extent / unit.scale) == pytest.approx([2.5, 4, 5], rel=0.03)


def test_mean_up_of_a_camera_that_rolls_over():
  poses = np.tile(np.eye(4), (40, 1, 1))
  angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
  poses[:, :3, :3] = [cv2.Rodrigues(np.array([0, 0, a]))[0] for a in angles]
  poses[:, 0, 3], poses[:, 1, 3] = np.cos(angles), np.sin(angles)
  assert abs(mean_up(poses)[2]) == pytest.approx(1)
