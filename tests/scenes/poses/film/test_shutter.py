"""Rolling shutter: pictures and pixels as if all lines were read at once."""

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.poses.film import shutter
from nerf2real.scenes.poses.film.readout import motion
from tests.scenes.poses.film.test_readout import CAMERA, filmed


def seen_while_turning():
  """Returns a motion, a picture of it, and where it shows points: at its middle line, as read."""
  model, times = filmed(0.03)
  found = motion(model, times, 0.03)
  index = 7
  points = np.array([[x, y, 1.0] for x in (-0.4, 0.1, 0.5) for y in (-0.25, 0.0, 0.28)])
  points *= found.depths[index]
  middle = CAMERA.project(points)
  read = middle
  for _ in range(6):
    read = found.project(points, shutter.instants(read, CAMERA), index, CAMERA)
  return found, index, middle, read


def test_rectified_pictures_show_points_where_the_middle_line_saw_them():
  found, index, middle, read = seen_while_turning()
  assert np.abs(read - middle).max() > 2
  picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
  for x, y in read:
    cv2.circle(picture, (round((x - 0.5) * 16), round((y - 0.5) * 16)), 64, (255,) * 3, -1, 16, 4)
  straight = found.rectify(picture, CAMERA, index)
  for x, y in middle:
    window = straight[round(y) - 8 : round(y) + 8, round(x) - 8 : round(x) + 8, 0].astype(float)
    rows, columns = np.mgrid[:16, :16] + 0.5
    centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
    np.testing.assert_allclose(centre, [x - round(x) + 8, y - round(y) + 8], atol=0.25)


def test_pixels_are_straightened_as_pictures_are():
  found, index, middle, read = seen_while_turning()
  np.testing.assert_allclose(found.straightened(read, CAMERA, index), middle, atol=0.1)


def test_a_picture_held_upright_is_read_along_its_width():
  upright = Camera(width=360, height=640, fx=500.0, fy=500.0, cx=180.0, cy=320.0)
  pixels = np.array([[0.0, 320.0], [180.0, 10.0], [360.0, 600.0]])
  np.testing.assert_allclose(shutter.instants(pixels, upright), [-0.5, 0.0, 0.5])
