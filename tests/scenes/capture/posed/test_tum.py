"""TUM's layout as it is met: gaps, missing files, other units, conventions and cameras."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import trajectory
from nerf2real.scenes.capture.reading import read_capture
from tests.scenes.capture.posed.sequences import (
  POSES,
  SETTINGS,
  check,
  check_motion,
  copied,
)


def test_damaged_sequences_are_one_clear_line(tum, tmp_path):
  folder = tmp_path / "tum"
  folder.mkdir()
  (folder / "rgb.txt").write_text("1.0 rgb/0.png\n")
  (folder / "groundtruth.txt").write_text("9.0 0 0 0 0 0 0 1\n")
  with pytest.raises(CaptureError, match="no picture has a pose"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  (folder / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n")
  with pytest.raises(CaptureError, match="1 of 1 pictures are missing, as 0.png"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  (folder / "groundtruth.txt").write_text("1.0 0 0\n")
  with pytest.raises(CaptureError, match="expected 8 columns"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  (folder / "groundtruth.txt").write_bytes(b"# caf\xe9\n1.0 0 0 0 0 0 0 1\n")
  with pytest.raises(CaptureError, match=r"groundtruth\.txt is no text in UTF-8"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_a_sequence_without_trajectory_says_what_is_missing(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  (folder / "groundtruth.txt").rename(folder / "poses_of_mine.txt")
  with pytest.raises(CaptureError) as said:
    source_kind(folder)
  assert "rgb.txt of TUM's layout and no trajectory: expected groundtruth.txt" in str(said.value)
  assert f"or give {folder / 'rgb'} alone" in str(said.value)
  for name in ("rgb.txt", "depth.txt"):
    (folder / name).unlink()
  with pytest.raises(CaptureError, match=r"give one of them, such as .*tum/rgb"):
    source_kind(folder)


def test_poses_are_interpolated_and_gaps_left_out():
  rows = np.zeros((6, 8))
  rows[:, 0] = [0.0, 0.1, 0.2, 1.0, 1.1, 1.2]
  rows[:, 1] = rows[:, 0]
  turns = Rotation.from_rotvec(np.outer(rows[:, 0], [0, 0, 1.0]))
  rows[:, 4:] = turns.as_quat()
  rows[4, 1] = np.nan
  rows[5, 4:] = 0.0
  poses, known = trajectory.poses_at(rows, np.array([-0.01, 0.05, 0.2, 0.23, 0.6, 1.01, 1.1, 1.2]))
  np.testing.assert_array_equal(known, [True, True, True, False, False, True, False, False])
  np.testing.assert_allclose(poses[1, :3, 3], [0.05, 0, 0], atol=1e-9)
  expected = Rotation.from_rotvec([0, 0, 0.05]).as_matrix()
  np.testing.assert_allclose(poses[1, :3, :3], expected, atol=1e-9)


def test_an_association_file_may_list_depth_first(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  rows = [
    f"{100 + k / 30:.4f} depth/{k:03d}.png {100 + k / 30:.4f} rgb/{k:03d}.png"
    for k in range(len(POSES))
  ]
  (folder / "associations.txt").write_text("\n".join(rows))
  for name in ("rgb.txt", "depth.txt"):
    (folder / name).unlink()
  assert source_kind(folder) == "rgbd"
  check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_pictures_without_depth_are_left_out(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  for name in ("rgb/003.png", "depth/007.png"):
    (folder / name).unlink()
  capture = read_capture(
    folder, tmp_path / "images", settings=dataclasses.replace(SETTINGS, num_keyframes=16)
  )
  assert len(capture.images) == 14 and any("2 of 16" in text for text in capture.warnings)
  known = capture.known
  assert [path.stem for path in known.files] == [path.stem for path in known.depth_files]
  rows = [k for k in range(16) if k not in (3, 7)]
  np.testing.assert_allclose(known.world_from_camera, POSES[rows], atol=1e-5)
  for path in sorted((folder / "depth").iterdir())[4:]:
    path.unlink()
  capture = read_capture(folder, tmp_path / "images", settings=SETTINGS)
  assert not capture.known.depth_files and any("none used" in t for t in capture.warnings)


def test_pictures_far_from_all_depth_are_left_out_and_counted(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  rows = (folder / "depth.txt").read_text().splitlines()
  (folder / "depth.txt").write_text("\n".join(rows[:5] + rows[6:]))
  capture = read_capture(folder, tmp_path / "images", settings=SETTINGS)
  assert capture.known.depth_files
  assert "1 of 16 pictures have no depth within 0.02 s: left out." in capture.warnings
  (folder / "depth.txt").write_text("7.0 depth/000.png")
  capture = read_capture(folder, tmp_path / "images", settings=SETTINGS)
  assert not capture.known.depth_files and not len(capture.known.depth_poses)
  words = "16 of 16 pictures have no depth within 0.02 s: none of depth.txt used."
  assert words in capture.warnings


@pytest.mark.parametrize("axes", [np.eye(3), OPENGL_FROM_OPENCV])
@pytest.mark.parametrize("inverse", [False, True])
def test_unit_and_convention_are_read_as_the_pictures_ask_for(tum, tmp_path, axes, inverse):
  folder = copied(tum, tmp_path / "tum")
  rows = []
  for k, pose in enumerate(POSES):
    other = pose.copy()
    other[:3, :3] = other[:3, :3] @ axes
    other = np.linalg.inv(other) if inverse else other
    numbers = [*other[:3, 3], *Rotation.from_matrix(other[:3, :3]).as_quat()]
    rows.append(f"{100 + k / 30:.4f} " + " ".join(f"{value:.7f}" for value in numbers))
  (folder / "groundtruth.txt").write_text("\n".join(rows))
  for path in (folder / "depth").iterdir():
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), (depth / 5.0).astype(np.uint16))
  capture = read_capture(folder, tmp_path / "images", settings=SETTINGS)
  check(capture)
  check_motion(capture)
  assert capture.known.depth_unit == 1e-3 and any("1 mm" in text for text in capture.warnings)


def test_poses_of_another_size_are_refused_with_the_factor(tum, tmp_path):
  """The layout says metres: what a monocular tracker wrote into it is no metre of anything."""
  folder = copied(tum, tmp_path / "tum")
  rows = np.loadtxt(folder / "groundtruth.txt")
  rows[:, 1:4] *= 0.65
  np.savetxt(folder / "groundtruth.txt", rows)
  with pytest.raises(
    CaptureError, match=r"do not belong .* if their lengths are multiplied by 1\.5"
  ):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_mirrored_poses_are_read(tum, tmp_path):
  """As ICL-NUIM has them: y up in the camera and in the world, both left-handed."""
  folder = copied(tum, tmp_path / "tum")
  mirror = np.diag([1.0, -1.0, 1.0, 1.0])
  rows = []
  for k, pose in enumerate(POSES):
    other = mirror @ pose @ mirror
    numbers = [*other[:3, 3], *Rotation.from_matrix(other[:3, :3]).as_quat()]
    rows.append(f"{100 + k / 30:.4f} " + " ".join(f"{value:.7f}" for value in numbers))
  (folder / "groundtruth.txt").unlink()
  (folder / "livingRoom2.gt.freiburg").write_text("\n".join(rows))
  assert source_kind(folder) == "rgbd"
  capture = read_capture(folder, tmp_path / "images", settings=SETTINGS)
  check(capture)
  check_motion(capture)
  assert any("mirrored y axes" in text for text in capture.warnings)
  (folder / "camera_info.yaml").unlink()
  (folder / "calibration.txt").write_text("280 -280 159.5 119.5")
  with pytest.raises(CaptureError, match=r"fy is -280, expected more than 0: .*mirrored"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_poses_of_another_recording_are_refused(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  rng = np.random.default_rng(0)
  rows = [
    f"{100 + k / 30:.4f} " + " ".join(f"{v:.5f}" for v in rng.normal(size=7))
    for k in range(len(POSES))
  ]
  (folder / "groundtruth.txt").write_text("\n".join(rows))
  with pytest.raises(CaptureError, match="do not belong to the pictures"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_a_camera_is_read_from_other_tools_files_or_assumed(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  (folder / "camera_info.yaml").unlink()
  with pytest.raises(CaptureError, match="320x240, not TUM's 640x480: add camera_info.yaml"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  (folder / "calibration.txt").write_text("280 280 159.5 119.5")
  check(read_capture(folder, tmp_path / "images", settings=SETTINGS))
  (folder / "calibration.txt").write_text("280 280")
  with pytest.raises(CaptureError, match="holds 2 numbers, expected"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  columns = np.array([[280.0, 0, 159.5], [0, 280, 119.5], [0, 0, 1]]).T.ravel().tolist()
  (folder / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": columns}))
  check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_eight_bit_depth_and_streams_are_refused(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  for path in (folder / "depth").iterdir():
    cv2.imwrite(str(path), np.zeros((240, 320), np.uint8))
  with pytest.raises(CaptureError, match="found uint8 of shape .*, expected 16-bit grey"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  stream = tmp_path / "scene0000_00.sens"
  stream.write_bytes(b"sens")
  for source in (stream, tmp_path):
    with pytest.raises(CaptureError, match="SensReader"):
      source_kind(source)
