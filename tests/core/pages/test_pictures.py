"""Pictures of reports: embedding, thumbnails, colours of errors and depths."""

import base64

import cv2
import numpy as np

from nerf2real.core.pages import pictures


def test_lossless_pictures_come_back_as_they_were():
  image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
  kind, data = pictures.data_uri(image, lossless=True).split(",")
  assert kind == "data:image/png;base64"
  read = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
  np.testing.assert_array_equal(read[..., ::-1], image)
  assert pictures.data_uri(image[..., 0], lossless=False).startswith("data:image/jpeg;base64,")


def test_shrinking_keeps_proportions_and_never_enlarges():
  image = np.zeros((60, 80, 3), np.uint8)
  assert pictures.shrink(image, 40).shape == (30, 40, 3)
  assert pictures.shrink(image, 100) is image


def test_error_map_is_dark_where_pictures_agree():
  truth = np.full((2, 2, 3), 100, np.uint8)
  image = truth.copy()
  image[0, 0] = 36
  colors = pictures.error_map(truth, image).astype(int).sum(-1)
  assert colors[0, 0] > 500 > 50 > colors[1, 1]


def test_depth_map_is_red_near_blue_far_and_black_without_a_hit():
  colors = pictures.depth_map(np.array([[0.3, 9.5], [10.0, np.inf]])).astype(int)
  assert colors[0, 0, 0] > 100 > colors[0, 0, 2]
  assert colors[0, 1, 2] > colors[0, 1, 0]
  assert not colors[1, 1].any() and not pictures.depth_map(np.full((2, 2), np.inf)).any()
