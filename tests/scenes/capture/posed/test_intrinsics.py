"""Tests of cameras in the files of data sets: their first pixel's centre is (0, 0)."""

import json

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.posed import intrinsics

MATRIX = np.array([[525.0, 0, 319.5], [0, 526, 239.5], [0, 0, 1]])


@pytest.mark.parametrize(
  ("name", "text", "distortion"),
  [
    ("intrinsics.txt", "525 526 319.5 239.5", ()),
    ("calibration.txt", "525,526,319.5,239.5,0.1,-0.2,0.01,0.02", (0.1, -0.2, 0.01, 0.02)),
    ("camera-intrinsics.txt", "525 0 319.5\n0 526 239.5\n0 0 1", ()),
    ("camera_intrinsic.json", json.dumps({"intrinsic_matrix": MATRIX.T.ravel().tolist()}), ()),
  ],
)
def test_the_principal_point_is_moved_by_half_a_pixel(tmp_path, name, text, distortion):
  cv2.imwrite(str(tmp_path / "picture.png"), np.zeros((480, 640, 3), np.uint8))
  (tmp_path / name).write_text(text)
  found = intrinsics.given_camera(tmp_path, tmp_path / "picture.png")
  lens = dict(zip(("k1", "k2", "p1", "p2"), distortion, strict=False))
  expected = Camera(width=640, height=480, fx=525.0, fy=526.0, cx=320.0, cy=240.0, **lens)
  assert found == expected
