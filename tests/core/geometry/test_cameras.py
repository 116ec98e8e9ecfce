"""The camera model against OpenCV's."""

import dataclasses

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera, focal_length

CAMERA = Camera(
  width=64, height=48, fx=50, fy=51, cx=31, cy=25, k1=0.12, k2=-0.05, p1=0.01, p2=-0.005
)


def test_projection_agrees_with_opencv():
  points = np.random.default_rng(0).normal(size=(50, 3))
  points[:, 2] = 3 + np.abs(points[:, 2])
  expected, _ = cv2.projectPoints(
    points, np.zeros(3), np.zeros(3), CAMERA.matrix, CAMERA.distortion
  )
  np.testing.assert_allclose(CAMERA.project(points), expected[:, 0], atol=1e-9)


def test_rays_invert_projection_at_every_pixel():
  rays = CAMERA.rays()
  assert rays.shape == (48, 64, 3)
  u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
  np.testing.assert_allclose(CAMERA.project(2.5 * rays), np.stack([u, v], -1), atol=1e-9)


def test_resized_camera_sees_the_same_field():
  small = CAMERA.resized(32, 12)
  point = np.array([0.3, -0.2, 2.0])
  np.testing.assert_allclose(small.project(point), CAMERA.project(point) * [0.5, 0.25])


def test_vertical_field_of_view():
  camera = Camera.from_vertical_fov(np.radians(43.3), 40, 30)
  assert camera.vertical_fov == pytest.approx(np.radians(43.3))
  assert camera.fx == camera.fy == focal_length(np.radians(43.3), 30)
  top, bottom = camera.rays(np.array([[20.0, 0.0], [20.0, 30.0]]))
  cosine = top @ bottom / np.linalg.norm(top) / np.linalg.norm(bottom)
  assert np.degrees(np.arccos(cosine)) == pytest.approx(43.3)


@pytest.mark.parametrize("change", [{"width": 0}, {"height": -1}, {"fx": 0.0}])
def test_impossible_cameras_are_refused(change):
  with pytest.raises(ValueError, match="found"):
    dataclasses.replace(CAMERA, **change)


def test_opencv_and_ros_count_pixels_from_the_first_centre():
  again = Camera.from_opencv(CAMERA.width, CAMERA.height, CAMERA.opencv_matrix, CAMERA.distortion)
  assert dataclasses.astuple(again) == pytest.approx(dataclasses.astuple(CAMERA))
  flat = CAMERA.opencv_matrix.ravel()
  assert Camera.from_opencv(CAMERA.width, CAMERA.height, flat, CAMERA.distortion) == again
  points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.1, 2.0]])
  expected, _ = cv2.projectPoints(
    points, np.zeros(3), np.zeros(3), CAMERA.opencv_matrix, CAMERA.distortion
  )
  np.testing.assert_allclose(CAMERA.project(points), expected[:, 0] + 0.5, atol=1e-9)
