"""Tests of pictures with poses in a transforms.json."""

import json

import numpy as np
import pytest

from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.capture.reading import read_capture
from tests.scenes import synthetic_capture as synthetic

SETTINGS = CaptureSettings(num_keyframes=8)


def test_transforms_json(tmp_path):
  poses = synthetic.walk(9)
  source = tmp_path / "source"
  synthetic.write_transforms(
    source, poses, synthetic.CAMERA, k1=0.01, k2=-0.02, p1=0.001, p2=-0.002
  )
  result = read_capture(source, tmp_path / "keyframes", settings=CaptureSettings(num_keyframes=9))
  assert result.kind == "transforms"
  np.testing.assert_allclose(result.known.world_from_camera, poses, atol=1e-12)
  np.testing.assert_allclose(result.known.camera.distortion, [0.01, -0.02, 0.001, -0.002])
  half = CaptureSettings(num_keyframes=9, max_size=160)
  result = read_capture(source / "transforms.json", tmp_path / "keyframes", settings=half)
  assert result.known.camera.width == 160
  assert result.known.camera.fx == pytest.approx(synthetic.CAMERA.fx / 2)


def test_instant_ngp_angles_and_missing_suffix(tmp_path):
  poses = synthetic.walk(8)
  synthetic.write_transforms(tmp_path, poses, synthetic.CAMERA)
  values = json.loads((tmp_path / "transforms.json").read_text())
  for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model"):
    del values[name]
  values["camera_angle_x"] = 2 * np.arctan(0.5 * 320 / 280)
  for frame in values["frames"]:
    frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
  (tmp_path / "transforms.json").write_text(json.dumps(values))
  known = read_transforms(tmp_path)
  assert known.camera.fx == pytest.approx(280)
  assert known.camera.fy == pytest.approx(280)
  assert (known.camera.cx, known.camera.cy) == (160, 120)
  np.testing.assert_allclose(known.world_from_camera, poses, atol=1e-12)


def test_transforms_errors(tmp_path):
  poses = synthetic.walk(8)
  synthetic.write_transforms(tmp_path, poses, synthetic.CAMERA, camera_model="OPENCV_FISHEYE")
  with pytest.raises(CaptureError, match="OPENCV_FISHEYE found, expected OPENCV"):
    read_transforms(tmp_path)
  sheared = poses.copy()
  sheared[2, 0, 1] += 0.5
  synthetic.write_transforms(tmp_path, sheared, synthetic.CAMERA)
  with pytest.raises(CaptureError, match=r"view_002.png is no rigid pose"):
    read_transforms(tmp_path)
  for extra, words in (
    ({"is_fisheye": True}, "OPENCV_FISHEYE found, expected OPENCV: undistort the pictures"),
    ({"k3": 0.01}, "k3 = 0.01 found, expected a lens of k1, k2, p1, p2"),
    ({"k4": -0.01}, "k4 = -0.01 found"),
  ):
    synthetic.write_transforms(tmp_path, poses, synthetic.CAMERA, **extra)
    with pytest.raises(CaptureError, match=words):
      read_transforms(tmp_path)
  for extra, words in (
    ({"k1": None}, "k1 = None found, expected a number"),
    ({"w": "wide"}, "w = 'wide' found, expected a number"),
    ({"fl_x": 0}, "Focal lengths must be positive"),
  ):
    synthetic.write_transforms(tmp_path, poses, synthetic.CAMERA, **extra)
    with pytest.raises(CaptureError, match=rf"transforms\.json: {words}"):
      read_transforms(tmp_path)
  synthetic.write_transforms(tmp_path, poses, synthetic.CAMERA, k3=0.0, k4=0.0)
  assert len(read_transforms(tmp_path).files) == 8
  (tmp_path / "images" / "view_003.png").unlink()
  with pytest.raises(CaptureError, match=r"holds 7 pictures \(1 of 8 pictures or their depth are"):
    read_capture(tmp_path, tmp_path / "keyframes", settings=SETTINGS)
  for number in range(4, 8):
    (tmp_path / "images" / f"view_{number:03d}.png").unlink()
  with pytest.raises(CaptureError, match=r"5 of 8 pictures are missing, as view_003.png"):
    read_transforms(tmp_path)
  frame = {"file_path": 3, "transform_matrix": np.eye(4).tolist()}
  (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
  with pytest.raises(CaptureError, match=r"transforms\.json: 3 found as a picture's path"):
    read_transforms(tmp_path)
  (tmp_path / "transforms.json").write_text('{"frames": 3}')
  with pytest.raises(CaptureError, match="no transforms file"):
    read_transforms(tmp_path)


@pytest.mark.parametrize("place", [(0, 3), (1, 1)])
def test_frames_whose_pose_is_not_finite_are_left_out(tmp_path, place):
  synthetic.write_transforms(tmp_path, synthetic.walk(9), synthetic.CAMERA)
  values = json.loads((tmp_path / "transforms.json").read_text())
  row, column = place
  values["frames"][4]["transform_matrix"][row][column] = float("nan")
  (tmp_path / "transforms.json").write_text(json.dumps(values))
  known = read_transforms(tmp_path)
  kept = [k for k in range(9) if k != 4]
  assert [path.name for path in known.files] == [f"view_{k:03d}.png" for k in kept]
  np.testing.assert_allclose(known.world_from_camera, synthetic.walk(9)[kept], atol=1e-12)
  assert known.warnings == ("1 of 9 poses are lost: left out.",)
  for frame in values["frames"]:
    frame["transform_matrix"] = [[float("inf")] * 4] * 4
  (tmp_path / "transforms.json").write_text(json.dumps(values))
  with pytest.raises(CaptureError, match=r"transforms\.json holds no finite pose"):
    read_transforms(tmp_path)


def test_windows_separators_are_read(tmp_path):
  synthetic.write_transforms(tmp_path, synthetic.walk(8), synthetic.CAMERA)
  text = (tmp_path / "transforms.json").read_text()
  (tmp_path / "transforms.json").write_text(text.replace("images/", "images\\\\"))
  assert len(read_transforms(tmp_path).files) == 8
