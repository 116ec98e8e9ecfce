"""Tests of pictures with poses in a COLMAP model."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed.colmap_model import read_colmap, to_colmap, to_opencv
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.capture.reading import read_capture
from tests.scenes import synthetic_capture as synthetic

SETTINGS = CaptureSettings(num_keyframes=8)


def _model(names, poses):
  """A model of the synthetic camera without points."""
  model = pycolmap.Reconstruction()
  model.add_camera_with_trivial_rig(to_colmap(synthetic.CAMERA))
  for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
    image = pycolmap.Image(name=name, camera_id=1, image_id=number)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
  return model


@pytest.mark.parametrize("text", [False, True])
def test_colmap_model(tmp_path, text):
  poses = synthetic.walk(9)
  names = synthetic.write_images(tmp_path / "images", poses)
  points = np.random.default_rng(0).uniform(0, 3, (50, 3))
  model = _model(names, poses)
  for point in points:
    model.add_point3D(point, pycolmap.Track(), np.array([10, 20, 30], np.uint8))
  folder = tmp_path / "sparse" / "0"
  folder.mkdir(parents=True)
  (model.write_text if text else model.write_binary)(str(folder))
  result = read_capture(tmp_path, tmp_path / "keyframes", settings=CaptureSettings(num_keyframes=9))
  assert result.kind == "colmap"
  assert result.known.camera == synthetic.CAMERA
  np.testing.assert_allclose(result.known.world_from_camera, poses, atol=1e-9)
  np.testing.assert_allclose(np.sort(result.known.points, axis=0), np.sort(points, axis=0))
  (tmp_path / "images" / names[4]).unlink()
  with pytest.raises(CaptureError, match="1 pictures of the COLMAP model are missing"):
    read_colmap(tmp_path)


@pytest.mark.parametrize(
  ("model", "params", "expected"),
  [
    ("SIMPLE_PINHOLE", [200, 160, 120], (200, 200, 0, 0)),
    ("PINHOLE", [200, 210, 160, 120], (200, 210, 0, 0)),
    ("SIMPLE_RADIAL", [200, 160, 120, 0.1], (200, 200, 0.1, 0)),
    ("RADIAL", [200, 160, 120, 0.1, -0.2], (200, 200, 0.1, -0.2)),
    ("OPENCV", [200, 210, 160, 120, 0.1, -0.2, 0.01, 0.02], (200, 210, 0.1, -0.2)),
  ],
)
def test_colmap_cameras_project_alike(model, params, expected):
  theirs = pycolmap.Camera(camera_id=1, model=model, width=320, height=240, params=params)
  ours = to_opencv(theirs)
  assert (ours.fx, ours.fy, ours.k1, ours.k2) == expected
  point = np.array([0.2, -0.1, 1.5])
  np.testing.assert_allclose(ours.project(point), theirs.img_from_cam(point), atol=1e-9)


def test_fisheye_is_refused():
  camera = pycolmap.Camera(
    camera_id=1,
    model="OPENCV_FISHEYE",
    width=320,
    height=240,
    params=[200, 200, 160, 120, 0, 0, 0, 0],
  )
  with pytest.raises(CaptureError, match="OPENCV_FISHEYE"):
    to_opencv(camera)


def test_known_poses_selection_keeps_order():
  known = KnownPoses(
    kind="colmap",
    camera=synthetic.CAMERA,
    files=tuple("abcd"),
    world_from_camera=np.arange(4)[:, None, None] * np.ones((4, 4)),
    points=np.zeros((0, 3)),
    point_colors=np.zeros((0, 3), np.uint8),
    point_errors=np.zeros(0),
  )
  chosen = known.selected([1, 3], synthetic.CAMERA)
  assert chosen.files == ("b", "d")
  np.testing.assert_array_equal(chosen.world_from_camera[:, 0, 0], [1, 3])


def test_a_camera_of_no_picture_does_not_count(tmp_path):
  poses = synthetic.walk(8)
  model = _model(synthetic.write_images(tmp_path / "images", poses), poses)
  other = pycolmap.Camera(
    camera_id=2, model="PINHOLE", width=800, height=600, params=[700, 700, 400, 300]
  )
  model.add_camera_with_trivial_rig(other)
  model.write_text(str(tmp_path))
  assert read_colmap(tmp_path).camera == synthetic.CAMERA


def test_what_a_model_lacks_is_named(tmp_path):
  poses = synthetic.walk(8)
  _model(synthetic.write_images(tmp_path / "images", poses), poses).write_text(str(tmp_path))
  (tmp_path / "points3D.txt").unlink()
  with pytest.raises(CaptureError, match=r"lacks points3D\.txt: copy the whole model"):
    read_colmap(tmp_path)
