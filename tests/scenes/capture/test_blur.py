"""The width of a picture's blur: of focus and of motion, and whatever contrast the picture has."""

import cv2
import numpy as np
import pytest

from nerf2real.scenes.capture.media.blur import blur_width


@pytest.fixture(scope="module")
def boxes():
  """Grey boxes of any size and turn on a plain ground, 480x640."""
  rng = np.random.default_rng(2)
  picture = np.full((480, 640), 120, np.uint8)
  for _ in range(60):
    place = (rng.uniform(0, 640), rng.uniform(0, 480))
    box = cv2.boxPoints((place, tuple(rng.uniform(40, 120, 2)), rng.uniform(0, 90)))
    cv2.fillConvexPoly(picture, box.astype(np.int32), int(rng.integers(40, 220)))
  return picture


@pytest.mark.parametrize("deviation", [1.0, 2.0, 3.0, 5.0])
@pytest.mark.parametrize("contrast", [1.0, 0.25])
def test_a_focus_blur_has_its_width_at_any_contrast(boxes, deviation, contrast):
  blurred = cv2.GaussianBlur(boxes, (0, 0), deviation)
  faded = np.uint8(120 + contrast * (blurred.astype(float) - 120))
  assert blur_width(faded) == pytest.approx(deviation, rel=0.2, abs=0.3)


@pytest.mark.parametrize("angle", [0.0, 45.0, 90.0])
def test_a_motion_blur_counts_along_its_direction(boxes, angle):
  length = 15  # the slope of its edges is that of a Gaussian with 15 / sqrt(2 pi)
  kernel = np.zeros((2 * length + 1,) * 2, np.float32)
  way = length / 2 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
  ends = [tuple(int(v) for v in np.round(length + sign * way)) for sign in (-1, 1)]
  cv2.line(kernel, *ends, 1.0)
  moved = cv2.filter2D(boxes, -1, kernel / kernel.sum())
  assert blur_width(moved) == pytest.approx(length / np.sqrt(2 * np.pi), rel=0.2)
  assert blur_width(boxes) < 1.0


def test_a_picture_without_edges_shows_nothing():
  assert blur_width(np.full((480, 640), 90, np.uint8)) == 480
