"""Intrinsics that lie beside a sequence of pictures, in the files that data sets have.

All of them have the centre of the first pixel at (0, 0), as OpenCV: Open3D, whose own camera of
640x480 has its principal point at (319.5, 239.5), and the tools of TUM, ScanNet, 3DMatch and ETH3D
lift a depth pixel of column u by (u - cx) / fx.
"""

import json
import math
from pathlib import Path

import numpy as np

from nerf2real.core.geometry.camera_info import read_camera_info
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.media import stills
from nerf2real.scenes.capture.media.errors import CaptureError

CAMERA_INFO = "camera_info.yaml"
_OPEN3D = "camera_intrinsic.json"
# ScanNet's SensReader; ScanNet's 25,000 frames; 3DMatch and 7-Scenes' fusion; ETH3D's SLAM; others.
_NUMBERS = (
  "intrinsic/intrinsic_color.txt",
  "intrinsics_color.txt",
  "intrinsic_color.txt",
  "camera-intrinsics.txt",
  "calibration.txt",
  "intrinsics.txt",
  "intrinsic.txt",
)


def given_camera(source: Path, picture: Path) -> Camera | None:
  """Reads the camera that lies beside a sequence; None where there is none.

  Args:
    source: Folder of the sequence.
    picture: One of its pictures, of whose size the camera is.

  Raises:
    CaptureError: The file of a camera is damaged.
  """
  if (source / CAMERA_INFO).is_file():
    return read_camera_info(source / CAMERA_INFO)
  if (source / _OPEN3D).is_file():
    return _of_numbers(source / _OPEN3D, _open3d(source / _OPEN3D), picture)
  for name in _NUMBERS:
    if (source / name).is_file():
      return _of_numbers(source / name, _numbers(source / name), picture)
  return None


def picture_size(path: Path) -> tuple[int, int]:
  """Width and height of a picture as stored.

  Raises:
    CaptureError: It is damaged.
  """
  try:
    with stills.opened(path) as image:
      return image.size
  except (OSError, ValueError, SyntaxError) as error:
    raise CaptureError(f"{path} cannot be read as a picture ({error}).") from error


def _open3d(path: Path) -> np.ndarray:
  """Matrix [3, 3] of Open3D's file, which lists it by columns."""
  try:
    return np.array(json.loads(path.read_text())["intrinsic_matrix"], np.float64).reshape(3, 3).T
  except (ValueError, KeyError, TypeError) as error:
    raise CaptureError(f"{path} is no camera of Open3D: {error!r}.") from error


def _numbers(path: Path) -> np.ndarray:
  """All numbers of a text file."""
  try:
    return np.array([float(word) for word in path.read_text().replace(",", " ").split()])
  except ValueError as error:
    raise CaptureError(f"{path} holds something that is no number ({error}).") from error


def _of_numbers(path: Path, values: np.ndarray, picture: Path) -> Camera:
  """The camera of a matrix [3, 3] or [4, 4], or of fx, fy, cx, cy and perhaps k1, k2, p1, p2."""
  flat = values.ravel()
  if flat.size in (9, 16):
    side = math.isqrt(flat.size)
    matrix = flat.reshape(side, side)
    flat = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
  if flat.size in (4, 8) and (flat[:2] <= 0).any():
    row = int(np.argmax(flat[:2] <= 0))
    raise CaptureError(
      f"{path}: {('fx', 'fy')[row]} is {flat[row]:g}, expected more than 0: give its absolute "
      "value, ICL-NUIM's mirrored poses are told by the depth."
    )
  if flat.size not in (4, 8) or not np.isfinite(flat).all():
    raise CaptureError(
      f"{path} holds {values.size} numbers, expected a 3x3 or 4x4 camera matrix or fx, fy, cx, cy."
    )
  width, height = picture_size(picture)
  fx, fy, cx, cy, *lens = flat.tolist()
  return Camera.from_opencv(width, height, [fx, 0, cx, 0, fy, cy, 0, 0, 1], lens or [0.0] * 4)
