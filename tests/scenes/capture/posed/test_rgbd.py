"""RGB-D sequences with known poses: TUM's and 7-Scenes' folders, transforms.json with depth."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.rotations import OPENGL_FROM_OPENCV
from nerf2real.core.similarity import Similarity
from nerf2real.scenes.alignment import scale
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.floor import Floor
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import depth_pictures, trajectory
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from nerf2real.scenes.stages import radiance_field
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from tests.scenes import synthetic_capture as synthetic

SETTINGS = CaptureSettings(num_keyframes=8)
POSES = synthetic.walk(16)
INFO = """image_width: 320
image_height: 240
distortion_model: plumb_bob
camera_matrix: {data: [280.0, 0, 159.5, 0, 280.0, 119.5, 0, 0, 1]}
distortion_coefficients: {data: [0, 0, 0, 0, 0]}
"""


def _pictures(folder, color, depth, unit):
  """Writes colour and depth pictures under the names' patterns."""
  for row, pose in enumerate(POSES):
    image, reach = synthetic.cast(pose)
    for name, picture in (
      (color.format(row), image),
      (depth.format(row), np.where(np.isfinite(reach), reach / unit, 0).astype(np.uint16)),
    ):
      (folder / name).parent.mkdir(parents=True, exist_ok=True)
      cv2.imwrite(str(folder / name), picture)


@pytest.fixture(scope="module")
def tum(tmp_path_factory):
  folder = tmp_path_factory.mktemp("tum")
  _pictures(folder, "rgb/{:03d}.png", "depth/{:03d}.png", 1 / 5000)
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


def _off_the_planes(points):
  """Distance [P] of points [P, 3] from the nearest of the three planes."""
  return np.abs(points - [3.0, 3.0, 0.0]).min(-1)


def _check(capture):
  known = capture.known
  numbers = [int(path.stem.split("_")[1]) for path in capture.images]
  np.testing.assert_allclose(known.world_from_camera, POSES[numbers], atol=1e-5)
  assert known.is_metric and len(known.sightings) > 8 * 200
  assert _off_the_planes(known.points).max() < 0.005
  # a point lies where its pixel looks
  picture, x, y, reach = known.sightings[len(known.sightings) // 2]
  pose = known.world_from_camera[int(picture)]
  local = (known.points[len(known.points) // 2] - pose[:3, 3]) @ pose[:3, :3]
  np.testing.assert_allclose(known.camera.project(local), [x, y], atol=1e-3)
  assert np.linalg.norm(local) == pytest.approx(reach)


def test_a_tum_sequence_gives_poses_and_depth(tum, tmp_path):
  assert source_kind(tum) == "rgbd"
  capture = read_capture(tum, tmp_path / "images", settings=SETTINGS)
  _check(capture)
  keyframes.save(capture, tmp_path)
  again = keyframes.load(tmp_path, tmp_path / "images")
  np.testing.assert_allclose(again.known.sightings, capture.known.sightings)


def _check_motion(capture):
  """The depth of every picture but the last was measured 0.12 of a step later."""
  numbers = [int(path.stem.split("_")[1]) for path in capture.images][:-1]
  steps = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=-1)[numbers]
  moved = np.linalg.norm(capture.known.picture_from_depth[:-1, :3, 3], axis=-1)
  np.testing.assert_allclose(moved, 0.12 * steps, rtol=0.02)


def test_depth_of_another_clock_has_poses_of_its_own(tum, tmp_path):
  """Its list says that it came 4 ms later, an eighth of the way to the next pose."""
  _check_motion(read_capture(tum, tmp_path / "images", settings=SETTINGS))
  joint = _copied(tum, tmp_path / "tum")
  rows = [
    f"{100 + k / 30:.4f} rgb/{k:03d}.png {100 + k / 30:.4f} depth/{k:03d}.png" for k in range(16)
  ]
  (joint / "associations.txt").write_text("\n".join(rows))
  for name in ("rgb.txt", "depth.txt"):
    (joint / name).unlink()
  known = read_capture(joint, tmp_path / "images", settings=SETTINGS).known
  assert known.picture_from_depth is None


def test_a_seven_scenes_sequence_gives_poses_and_depth(tmp_path):
  folder = tmp_path / "seq-01"
  _pictures(folder, "frame-{:06d}.color.png", "frame-{:06d}.depth.png", 1e-3)
  (folder / "camera_info.yaml").write_text(INFO)
  for row, pose in enumerate(POSES):
    np.savetxt(folder / f"frame-{row:06d}.pose.txt", pose)
  _check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_a_scannet_scene_gives_poses_and_depth(tmp_path):
  folder = tmp_path / "scene0000_00"
  _pictures(folder, "color/{}.jpg", "depth/{}.png", 1e-3)
  for name in ("pose", "intrinsic"):
    (folder / name).mkdir()
  matrix = np.diag([280.0, 280.0, 1.0, 1.0])
  matrix[:2, 2] = 160.0, 120.0
  np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
  for row, pose in enumerate(POSES):
    np.savetxt(folder / "pose" / f"{row}.txt", pose)
  assert source_kind(folder) == "rgbd"
  with pytest.raises(CaptureError, match="give one of them, such as .*scene0000_00"):
    source_kind(tmp_path)
  _check(read_capture(folder, tmp_path / "images", settings=SETTINGS))
  lost = np.full((4, 4), -np.inf)
  for row in range(len(POSES)):
    np.savetxt(folder / "pose" / f"{row}.txt", lost)
  with pytest.raises(CaptureError, match="holds a finite pose"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_transforms_with_depth_give_points(tmp_path):
  _pictures(tmp_path, "rgb/{:03d}.png", "depth/{:03d}.png", 1e-3)
  frames = []
  for row, pose in enumerate(POSES):
    matrix = pose.copy()
    matrix[:3, :3] = matrix[:3, :3] @ OPENGL_FROM_OPENCV
    names = {"file_path": f"rgb/{row:03d}.png", "depth_file_path": f"depth/{row:03d}.png"}
    frames.append(names | {"transform_matrix": matrix.tolist()})
  about = {"w": 320, "h": 240, "fl_x": 280.0, "frames": frames}
  (tmp_path / "transforms.json").write_text(json.dumps(about))
  _check(read_capture(tmp_path, tmp_path / "images", settings=SETTINGS))


def test_measured_depth_comes_at_the_size_of_the_pictures(tum, tmp_path):
  capture = read_capture(tum, tmp_path / "images", settings=SETTINGS)
  known = capture.known
  camera = known.camera.resized(80, 60)
  depth = depth_pictures.measured_depth(known.depth_files[3], known.depth_unit, camera)
  points = (camera.rays() * depth[..., None])[depth > 0]
  pose = known.world_from_camera[3]
  assert (depth > 0).mean() > 0.5
  # half a pixel of the sensor's: 2 mm a metre across, more where a surface is grazed
  off = _off_the_planes(points @ pose[:3, :3].T + pose[:3, 3])
  assert np.percentile(off, 90) < 0.02
  spoilt = cv2.imread(str(known.depth_files[3]), cv2.IMREAD_UNCHANGED)
  spoilt[:] = 65535
  cv2.imwrite(str(tmp_path / "nothing.png"), spoilt)
  assert not depth_pictures.measured_depth(tmp_path / "nothing.png", 1e-3, camera).any()


def test_measured_depth_stands_for_the_fields(tum, tmp_path):
  capture = read_capture(tum, tmp_path / "images", settings=SETTINGS)
  first, *others = capture.known.depth_files
  gap = cv2.imread(str(first), cv2.IMREAD_UNCHANGED)
  gap[:120] = 0
  cv2.imwrite(str(tmp_path / "gap.png"), gap)
  known = dataclasses.replace(capture.known, depth_files=(tmp_path / "gap.png", *others))
  capture = dataclasses.replace(capture, known=known)
  found = localise(tmp_path / "images", tmp_path / "poses", known=capture.known)

  def made(value):
    return Made(value, StageResult(tmp_path, "key", "made", 0.0, cached=False))

  def render(camera, pose):
    size = (camera.height, camera.width)
    return np.zeros((*size, 3), np.uint8), np.full(size, 9.0, np.float32)

  field = SimpleNamespace(renderer=SimpleNamespace(render=render))
  cache = Stages(tmp_path / "stages", show_progress=False)
  views = radiance_field.depth(cache, made(field), made(capture), made(found), width=80).value
  measured = views.depth != 9.0
  assert not measured[0, :30].any() and measured[1:].mean() > 0.9
  rays = views.camera.rays()
  for depth, there, pose in zip(views.depth, measured, views.frame_from_camera, strict=True):
    points = (rays * depth[..., None])[there] @ pose[:3, :3].T + pose[:3, 3]
    off = _off_the_planes(found.unit_from_source.inverse().apply(points))
    assert np.percentile(off, 90) < 0.03


def test_known_poses_and_depth_keep_the_scale(tum, tmp_path):
  capture = read_capture(tum, tmp_path / "images", settings=SETTINGS)
  found = localise(tmp_path / "images", tmp_path / "poses", known=capture.known)
  assert found.registered_fraction == 1.0 and "rgbd" in found.strategy
  metres = found.unit_from_source.inverse()
  assert _off_the_planes(metres.apply(found.points)).max() < 0.006
  floor = Floor(np.array([0, 0, 1.0]), -0.5, 100, 1.0, 0.0, 0.0)
  evidence = Evidence(found.points, found.world_from_camera, sensor_scale=metres.scale)
  chosen = scale.choose_scale(
    evidence,
    Overrides(),
    floor=floor,
    camera_height=1.0,
    guessed_camera_height=1.4,
    max_marker_spread=0.05,
  )
  assert chosen.source == "depth_sensor" and chosen.value.metres_per_unit == metres.scale


def test_metric_poses_are_adjusted_to_the_pictures(tum, tmp_path):
  """Poses with the noise of a tracker, a nominal lens: both are better afterwards, and metric.

  A picture of nothing keeps its pose.
  """
  folder = _copied(tum, tmp_path / "tum")
  cv2.imwrite(str(folder / "rgb" / "005.png"), np.full((240, 320, 3), 128, np.uint8))
  rng = np.random.default_rng(0)
  rows = []
  for k, pose in enumerate(POSES):
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(0.4), 3))
    numbers = [*(pose[:3, 3] + rng.normal(0, 0.008, 3))]
    numbers += [*(turn * Rotation.from_matrix(pose[:3, :3])).as_quat()]
    rows.append(f"{100 + k / 30:.4f} " + " ".join(f"{value:.7f}" for value in numbers))
  (folder / "groundtruth.txt").write_text("\n".join(rows))
  (folder / "camera_info.yaml").write_text(INFO.replace("280.0", "286.0"))
  settings = dataclasses.replace(SETTINGS, num_keyframes=16)
  capture = read_capture(folder, tmp_path / "images", settings=settings)

  def off(found):
    metres = found.unit_from_source.inverse()
    poses = metres.apply_pose(found.world_from_camera)
    best = Similarity.fit(poses[:, :3, 3], POSES[:, :3, 3], with_scale=False)
    place = np.linalg.norm(best.apply(poses[:, :3, 3]) - POSES[:, :3, 3], axis=-1)
    steps, true = (
      Rotation.from_matrix(np.swapaxes(p[:-1, :3, :3], 1, 2) @ p[1:, :3, :3])
      for p in (poses, POSES)
    )
    angle = (steps.inv() * true).magnitude()
    return np.median(place), np.degrees(np.median(angle)), abs(found.camera.fx / 280 - 1)

  def located(name, refine_known):
    return localise(
      tmp_path / "images",
      tmp_path / name,
      known=capture.known,
      settings=LocaliseSettings(refine_known=refine_known),
    )

  plain, refined = located("plain", False), located("refined", True)
  assert "adjusted" in refined.strategy and "adjusted" not in plain.strategy
  assert refined.registered_fraction == 1.0 and refined.reprojection_error_px < 1.0
  for after, before in zip(off(refined), off(plain), strict=True):
    assert after < 0.5 * before
  kept = refined.unit_from_source.inverse().apply_pose(refined.world_from_camera)[5]
  np.testing.assert_allclose(kept, capture.known.world_from_camera[5], atol=1e-6)


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


def test_a_sequence_without_trajectory_says_what_is_missing(tum, tmp_path):
  folder = _copied(tum, tmp_path / "tum")
  (folder / "groundtruth.txt").rename(folder / "poses_of_mine.txt")
  with pytest.raises(CaptureError) as said:
    source_kind(folder)
  assert "rgb.txt of TUM's layout and no trajectory: expected groundtruth.txt" in str(said.value)
  assert f"or give {folder / 'rgb'} alone" in str(said.value)
  for name in ("rgb.txt", "depth.txt"):
    (folder / name).unlink()
  with pytest.raises(CaptureError, match=r"give one of them, such as .*tum/rgb"):
    source_kind(folder)


def _copied(tum, folder):
  shutil.copytree(tum, folder)
  return folder


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
  folder = _copied(tum, tmp_path / "tum")
  rows = [
    f"{100 + k / 30:.4f} depth/{k:03d}.png {100 + k / 30:.4f} rgb/{k:03d}.png"
    for k in range(len(POSES))
  ]
  (folder / "associations.txt").write_text("\n".join(rows))
  for name in ("rgb.txt", "depth.txt"):
    (folder / name).unlink()
  assert source_kind(folder) == "rgbd"
  _check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_pictures_without_depth_are_left_out(tum, tmp_path):
  folder = _copied(tum, tmp_path / "tum")
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
  folder = _copied(tum, tmp_path / "tum")
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
  folder = _copied(tum, tmp_path / "tum")
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
  _check(capture)
  _check_motion(capture)
  assert capture.known.depth_unit == 1e-3 and any("1 mm" in text for text in capture.warnings)


def test_poses_of_another_recording_are_refused(tum, tmp_path):
  folder = _copied(tum, tmp_path / "tum")
  rng = np.random.default_rng(0)
  rows = [
    f"{100 + k / 30:.4f} " + " ".join(f"{v:.5f}" for v in rng.normal(size=7))
    for k in range(len(POSES))
  ]
  (folder / "groundtruth.txt").write_text("\n".join(rows))
  with pytest.raises(CaptureError, match="do not belong to the pictures"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_a_camera_is_read_from_other_tools_files_or_assumed(tum, tmp_path):
  folder = _copied(tum, tmp_path / "tum")
  (folder / "camera_info.yaml").unlink()
  with pytest.raises(CaptureError, match="320x240, not TUM's 640x480: add camera_info.yaml"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  (folder / "calibration.txt").write_text("280 280 160 120")
  _check(read_capture(folder, tmp_path / "images", settings=SETTINGS))
  (folder / "calibration.txt").write_text("280 280")
  with pytest.raises(CaptureError, match="holds 2 numbers, expected"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  columns = np.array([[280.0, 0, 160], [0, 280, 120], [0, 0, 1]]).T.ravel().tolist()
  (folder / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": columns}))
  _check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_eight_bit_depth_and_streams_are_refused(tum, tmp_path):
  folder = _copied(tum, tmp_path / "tum")
  for path in (folder / "depth").iterdir():
    cv2.imwrite(str(path), np.zeros((240, 320), np.uint8))
  with pytest.raises(CaptureError, match="found uint8 of shape .*, expected 16-bit grey"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)
  stream = tmp_path / "scene0000_00.sens"
  stream.write_bytes(b"sens")
  for source in (stream, tmp_path):
    with pytest.raises(CaptureError, match="SensReader"):
      source_kind(source)
