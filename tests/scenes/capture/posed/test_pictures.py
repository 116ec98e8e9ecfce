"""Tests of pictures with known poses: as stored where that is their camera's shape."""

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.posed.pictures import read_as_posed
from nerf2real.scenes.capture.reading import read_capture
from tests.scenes.capture.posed.sequences import SETTINGS, write_transforms

CAMERA = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
UPRIGHT = Camera(width=48, height=64, fx=60.0, fy=60.0, cx=24.0, cy=32.0)


def _tagged(path, orientation):
  """Says in EXIF how a picture is to be turned, and leaves its pixels."""
  exif = PIL.Image.Exif()
  exif[PIL.ExifTags.Base.Orientation] = orientation
  with PIL.Image.open(path) as image:
    image.load()
    image.save(path, exif=exif)


@pytest.mark.parametrize(
  ("orientation", "camera", "turns"), [(3, CAMERA, 0), (6, CAMERA, 0), (6, UPRIGHT, -1)]
)
def test_a_picture_is_turned_only_where_its_camera_is(tmp_path, orientation, camera, turns):
  stored = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
  path = tmp_path / "picture.png"
  cv2.imwrite(str(path), stored)
  _tagged(path, orientation)
  np.testing.assert_array_equal(read_as_posed(path, camera), np.rot90(stored, turns))


def test_keyframes_and_colours_of_posed_pictures_are_as_stored(tmp_path):
  write_transforms(tmp_path)
  plain = read_capture(tmp_path, tmp_path / "plain", settings=SETTINGS)
  for path in (tmp_path / "rgb").iterdir():
    _tagged(path, 3)
  tagged = read_capture(tmp_path, tmp_path / "tagged", settings=SETTINGS)
  for one, other in zip(plain.images, tagged.images, strict=True):
    np.testing.assert_array_equal(cv2.imread(str(one)), cv2.imread(str(other)))
  np.testing.assert_array_equal(plain.known.point_colors, tagged.known.point_colors)
