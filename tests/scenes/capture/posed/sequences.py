"""Small RGB-D sequences in TUM's layout, and what is asked of what is read from them."""

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.scenes.capture.capture import CaptureSettings
from tests.scenes import synthetic_capture as synthetic

SETTINGS = CaptureSettings(num_keyframes=8)
POSES = synthetic.walk(16)
INFO = """image_width: 320
image_height: 240
distortion_model: plumb_bob
camera_matrix: {data: [280.0, 0, 159.5, 0, 280.0, 119.5, 0, 0, 1]}
distortion_coefficients: {data: [0, 0, 0, 0, 0]}
"""


def pictures(folder, color, depth, unit):
  """Writes colour and depth pictures under the names' patterns."""
  for row, pose in enumerate(POSES):
    image, reach = synthetic.cast(pose)
    for name, picture in (
      (color.format(row), image),
      (depth.format(row), np.where(np.isfinite(reach), reach / unit, 0).astype(np.uint16)),
    ):
      (folder / name).parent.mkdir(parents=True, exist_ok=True)
      cv2.imwrite(str(folder / name), picture)


def off_the_planes(points):
  """Distance [P] of points [P, 3] from the nearest of the three planes."""
  return np.abs(points - [3.0, 3.0, 0.0]).min(-1)


def check(capture):
  known = capture.known
  numbers = [int(path.stem.split("_")[1]) for path in capture.images]
  np.testing.assert_allclose(known.world_from_camera, POSES[numbers], atol=1e-5)
  assert known.is_metric and len(known.sightings) > 8 * 200
  assert off_the_planes(known.points).max() < 0.005
  # a point lies where its pixel looks
  picture, x, y, reach = known.sightings[len(known.sightings) // 2]
  pose = known.world_from_camera[int(picture)]
  local = (known.points[len(known.points) // 2] - pose[:3, 3]) @ pose[:3, :3]
  np.testing.assert_allclose(known.camera.project(local), [x, y], atol=1e-3)
  assert np.linalg.norm(local) == pytest.approx(reach)


def check_motion(capture):
  """The depth of every picture but the last was measured 0.12 of a step later."""
  numbers = [int(path.stem.split("_")[1]) for path in capture.images][:-1]
  steps = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=-1)[numbers]
  moved = np.linalg.norm(capture.known.picture_from_depth[:-1, :3, 3], axis=-1)
  np.testing.assert_allclose(moved, 0.12 * steps, rtol=0.02)


def copied(tum, folder):
  shutil.copytree(tum, folder)
  return folder


def tum_sequence(folder):
  """Writes a sequence of colour, depth and poses; returns its folder."""
  pictures(folder, "rgb/{:03d}.png", "depth/{:03d}.png", 1 / 5000)
  (folder / "camera_info.yaml").write_text(INFO)
  times = 100 + np.arange(len(POSES)) / 30
  for kind, late in (("rgb", 0.0), ("depth", 0.004)):
    rows = [f"{t + late:.4f} {kind}/{k:03d}.png" for k, t in enumerate(times)]
    (folder / f"{kind}.txt").write_text("\n".join(["# a comment", *rows]))
  rows = []
  for t, pose in zip(times, POSES, strict=True):
    numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
    rows.append(f"{t:.4f} " + " ".join(f"{value:.7f}" for value in numbers))
  (folder / "groundtruth.txt").write_text("\n".join(rows))
  return folder


def write_transforms(folder):
  """Writes colour, depth and a transforms.json; returns what that says."""
  pictures(folder, "rgb/{:03d}.png", "depth/{:03d}.png", 1e-3)
  frames = []
  for row, pose in enumerate(POSES):
    matrix = pose.copy()
    matrix[:3, :3] = matrix[:3, :3] @ OPENGL_FROM_OPENCV
    names = {"file_path": f"rgb/{row:03d}.png", "depth_file_path": f"depth/{row:03d}.png"}
    frames.append(names | {"transform_matrix": matrix.tolist()})
  about = {"w": 320, "h": 240, "fl_x": 280.0, "frames": frames}
  (folder / "transforms.json").write_text(json.dumps(about))
  return about
