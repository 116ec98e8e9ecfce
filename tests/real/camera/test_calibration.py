"""Calibration on boards drawn through a known lens, and on a phone's film of a board."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from nerf2real.core.geometry.camera_info import read_camera_info
from nerf2real.core.geometry.cameras import Camera
from nerf2real.real.camera import calibration

MEASURED = Path("../shared/data/captures/ridgesfm_livingroom/calibrate.mp4")
LENS = Camera(
  width=480,
  height=360,
  fx=390.0,
  fy=386.0,
  cx=247.5,
  cy=177.5,
  k1=0.12,
  k2=-0.25,
  p1=0.002,
  p2=-0.003,
)
CORNERS = (7, 5)


@functools.cache
def _fine_rays():
  fine = LENS.resized(2 * LENS.width, 2 * LENS.height)
  return fine.rays()


def _draw(pose):
  """Draws 8 x 6 squares of 1 unit as the lens sees them: every pixel's ray meets the board."""
  rays = _fine_rays()
  rotation, origin = pose[:3, :3], pose[:3, 3]  # camera from board
  normal = rotation[:, 2]
  depth = (origin @ normal) / (rays @ normal)
  board = (rays * depth[..., None] - origin) @ rotation
  x, y = board[..., 0], board[..., 1]
  inside = (x > -1) & (x < 7) & (y > -1) & (y < 5)
  dark = (np.floor(x).astype(int) + np.floor(y).astype(int)) % 2 == 0
  picture = np.where(inside & dark, 40, 220).astype(np.uint8)
  return cv2.resize(picture, (LENS.width, LENS.height), interpolation=cv2.INTER_AREA)


def _poses(count, seed=0):
  rng = np.random.default_rng(seed)
  for _ in range(count):
    rotation = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    aim = np.array([*rng.uniform(-1.5, 1.5, 2), rng.uniform(10, 14)])
    pose[:3, 3] = aim - rotation @ [3, 2, 0]
    yield pose


@pytest.fixture(scope="module")
def result():
  views = [
    calibration.find_board(f"view {k}", _draw(pose), corners=CORNERS)
    for k, pose in enumerate(_poses(24))
  ]
  found = [view for view in views if view is not None]
  assert len(found) > 18
  # One view whose corners are wrong must not spoil the lens.
  wrong = calibration.View(
    name="wrong",
    size=found[0].size,
    corners=found[0].corners
    + np.random.default_rng(1).normal(0, 4, found[0].corners.shape).astype(np.float32),
  )
  return calibration.calibrate([*found, wrong], corners=CORNERS)


def test_known_lens_is_found(result):
  truth = np.array([LENS.fx, LENS.fy, LENS.cx - 0.5, LENS.cy - 0.5, *LENS.distortion])
  error = np.abs(result.values - truth)
  assert error[:4].max() < 1.5 and result.rejected == ("wrong",) and result.rms < 0.2
  assert (error < 4 * result.stddevs + 1e-3).all()
  assert result.camera.cx == pytest.approx(LENS.cx, abs=1.5)
  rays = result.camera.rays() - LENS.rays()
  assert np.linalg.norm(rays, axis=-1).mean() < 2e-3  # a pixel at fx = 520


def test_camera_info_is_what_ros_writes(result, tmp_path):
  path = tmp_path / "camera_info.yaml"
  calibration.write_camera_info(path, result, name="c920")
  info = yaml.safe_load(path.read_text())
  assert set(info) == {
    "image_width",
    "image_height",
    "camera_name",
    "camera_matrix",
    "distortion_model",
    "distortion_coefficients",
    "rectification_matrix",
    "projection_matrix",
  }
  assert info["camera_name"] == "c920" and info["distortion_model"] == "plumb_bob"
  assert info["camera_matrix"]["rows"] == 3 and len(info["projection_matrix"]["data"]) == 12
  assert info["camera_matrix"]["data"][2] == pytest.approx(result.values[2])
  assert "+-" in path.read_text()
  assert read_camera_info(path) == result.camera


def test_errors_say_what_to_do(tmp_path):
  with pytest.raises(ValueError, match="Found the board in 0 pictures, expected at least 8"):
    calibration.calibrate([], corners=CORNERS)
  with pytest.raises(ValueError, match="holds no pictures"):
    list(calibration.read_pictures(tmp_path))
  (tmp_path / "board.mp4").write_text("no film")
  with pytest.raises(ValueError, match="not a video"):
    list(calibration.read_pictures(tmp_path / "board.mp4"))
  other = tmp_path / "info.yaml"
  other.write_text("image_width: 3")
  with pytest.raises(ValueError, match="no camera_info"):
    read_camera_info(other)


def test_measured_film_of_a_phone():
  if not MEASURED.exists():
    pytest.skip(f"{MEASURED} is absent: the data sets beside the checkout are not here.")
  views = [
    view
    for name, picture in calibration.read_pictures(MEASURED, every=2)
    if (view := calibration.find_board(name, picture, corners=(7, 7))) is not None
  ]
  found = calibration.calibrate(views, corners=(7, 7))
  assert len(found.views) > 30
  # Measured independently: 667.8 +- 5.5 (SOURCE.md beside the film).
  assert found.values[0] == pytest.approx(668, abs=6)
  assert 1 < found.stddevs[0] < 12


@pytest.mark.parametrize(
  ("matrix", "coefficients"),
  [
    ("[600, 0, 320, 0, 601, 240, 0, 0]", "[0, 0, 0, 0]"),
    ("[0, 0, 320, 0, 601, 240, 0, 0, 1]", "[0, 0, 0, 0]"),
    ("[600, 0, 320, 0, 601, 240, 0, 0, 1]", "[k1, 0, 0, 0]"),
    ("[600, 0, 320, 0, 601, 240, 0, 0, 1]", "null"),
  ],
)
def test_a_camera_info_with_wrong_numbers_is_named(tmp_path, matrix, coefficients):
  path = tmp_path / "lens.yaml"
  path.write_text(
    "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
    f"camera_matrix: {{data: {matrix}}}\ndistortion_coefficients: {{data: {coefficients}}}\n"
  )
  with pytest.raises(ValueError, match=r"lens\.yaml is no camera_info YAML"):
    read_camera_info(path)
