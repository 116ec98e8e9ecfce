"""RGB-D sequences with known poses: TUM's and 7-Scenes' folders, transforms.json with depth."""

import dataclasses
import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.alignment import scale
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.floor import Floor
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.kinds import source_kind
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from nerf2real.scenes.stages import radiance_field
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from tests.scenes.capture.posed.sequences import (
  INFO,
  POSES,
  SETTINGS,
  check,
  check_motion,
  copied,
  off_the_planes,
  pictures,
  write_transforms,
)

FEW = LocaliseSettings(features=FeatureSettings(few_num_features=1000))


@pytest.fixture(scope="module")
def capture(tum, tmp_path_factory):
  """The recording, read once; its pictures lie in the folder of the first."""
  return read_capture(tum, tmp_path_factory.mktemp("capture") / "images", settings=SETTINGS)


def test_a_tum_sequence_gives_poses_and_depth(tum, capture, tmp_path):
  assert source_kind(tum) == "rgbd"
  check(capture)
  keyframes.save(capture, tmp_path)
  again = keyframes.load(tmp_path, capture.images[0].parent)
  np.testing.assert_allclose(again.known.sightings, capture.known.sightings)


def test_depth_of_another_clock_has_poses_of_its_own(tum, capture, tmp_path):
  """Its list says that it came 4 ms later, an eighth of the way to the next pose."""
  check_motion(capture)
  joint = copied(tum, tmp_path / "tum")
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
  pictures(folder, "frame-{:06d}.color.png", "frame-{:06d}.depth.png", 1e-3)
  (folder / "camera_info.yaml").write_text(INFO)
  for row, pose in enumerate(POSES):
    np.savetxt(folder / f"frame-{row:06d}.pose.txt", pose)
  check(read_capture(folder, tmp_path / "images", settings=SETTINGS))


def test_a_scannet_scene_gives_poses_and_depth(tmp_path):
  folder = tmp_path / "scene0000_00"
  pictures(folder, "color/{}.jpg", "depth/{}.png", 1e-3)
  for name in ("pose", "intrinsic"):
    (folder / name).mkdir()
  matrix = np.diag([280.0, 280.0, 1.0, 1.0])
  matrix[:2, 2] = 159.5, 119.5
  np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", matrix)
  for row, pose in enumerate(POSES):
    np.savetxt(folder / "pose" / f"{row}.txt", pose)
  (folder / "pose" / "._0.txt").write_bytes(b"Mac OS X resource fork")
  assert source_kind(folder) == "rgbd"
  with pytest.raises(CaptureError, match="give one of them, such as .*scene0000_00"):
    source_kind(tmp_path)
  check(read_capture(folder, tmp_path / "images", settings=SETTINGS))
  lost = np.full((4, 4), -np.inf)
  for row in range(len(POSES)):
    np.savetxt(folder / "pose" / f"{row}.txt", lost)
  with pytest.raises(CaptureError, match="holds no finite pose"):
    read_capture(folder, tmp_path / "images", settings=SETTINGS)


def test_transforms_with_depth_give_points(tmp_path):
  write_transforms(tmp_path)
  check(read_capture(tmp_path, tmp_path / "images", settings=SETTINGS))


def test_frames_of_transforms_without_picture_or_depth_are_left_out(tmp_path):
  about = write_transforms(tmp_path)
  del about["frames"][1]["depth_file_path"]
  for name in ("rgb/003.png", "depth/007.png"):
    (tmp_path / name).unlink()
  (tmp_path / "transforms.json").write_text(json.dumps(about))
  known = read_transforms(tmp_path)
  rows = [k for k in range(16) if k not in (1, 3, 7)]
  assert [path.name for path in known.files] == [f"{k:03d}.png" for k in rows]
  assert [path.stem for path in known.files] == [path.stem for path in known.depth_files]
  np.testing.assert_allclose(known.world_from_camera, POSES[rows], atol=1e-12)
  assert known.warnings == ("3 of 16 pictures or their depth are missing: left out.",)
  for frame in about["frames"][2:]:
    frame.pop("depth_file_path")
  (tmp_path / "transforms.json").write_text(json.dumps(about))
  known = read_transforms(tmp_path)
  assert len(known.files) == 15 and not known.depth_files
  assert "15 of 16 depth pictures are missing: none used." in known.warnings


def test_pictures_whose_depth_is_damaged_are_left_out_and_counted(tum, tmp_path):
  folder = copied(tum, tmp_path / "tum")
  broken = sorted((folder / "depth").iterdir())
  broken[3].write_bytes(b"")
  broken[7].write_bytes(broken[7].read_bytes()[:400])
  settings = dataclasses.replace(SETTINGS, num_keyframes=16)
  capture = read_capture(folder, tmp_path / "images", settings=settings)
  check(capture)
  assert [path.stem for path in capture.known.files] == [
    f"{k:03d}" for k in range(16) if k not in (3, 7)
  ]
  assert any(
    text.startswith("2 of 16 depth pictures that were tried cannot be read: left out with")
    and "003.png" in text
    for text in capture.warnings
  )
  for path in broken[:9]:
    path.write_bytes(b"")
  with pytest.raises(CaptureError, match=r"9 of 16 depth .*: .*000\.png is no depth picture"):
    read_capture(folder, tmp_path / "images", settings=settings)


def test_measured_depth_comes_at_the_size_of_the_pictures(capture, tmp_path):
  known = capture.known
  camera = known.camera.resized(80, 60)
  depth = depth_pictures.measured_depth(known.depth_files[3], known.depth_unit, camera)
  points = (camera.rays() * depth[..., None])[depth > 0]
  pose = known.world_from_camera[3]
  assert (depth > 0).mean() > 0.5
  # half a pixel of the sensor's: 2 mm a metre across, more where a surface is grazed
  off = off_the_planes(points @ pose[:3, :3].T + pose[:3, 3])
  assert np.percentile(off, 90) < 0.02
  spoilt = cv2.imread(str(known.depth_files[3]), cv2.IMREAD_UNCHANGED)
  spoilt[:] = 65535
  cv2.imwrite(str(tmp_path / "nothing.png"), spoilt)
  assert not depth_pictures.measured_depth(tmp_path / "nothing.png", 1e-3, camera).any()


def test_measured_depth_stands_for_the_fields(capture, tmp_path):
  first, *others = capture.known.depth_files
  gap = cv2.imread(str(first), cv2.IMREAD_UNCHANGED)
  gap[:120] = 0
  cv2.imwrite(str(tmp_path / "gap.png"), gap)
  known = dataclasses.replace(capture.known, depth_files=(tmp_path / "gap.png", *others))
  capture = dataclasses.replace(capture, known=known)
  images = capture.images[0].parent
  found = localise(images, tmp_path / "poses", known=capture.known, settings=FEW)

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
    off = off_the_planes(found.unit_from_source.inverse().apply(points))
    assert np.percentile(off, 90) < 0.03


def test_known_poses_and_depth_keep_the_scale(capture, tmp_path):
  images = capture.images[0].parent
  found = localise(images, tmp_path / "poses", known=capture.known, settings=FEW)
  assert found.registered_fraction == 1.0 and "rgbd" in found.strategy
  metres = found.unit_from_source.inverse()
  assert off_the_planes(metres.apply(found.points)).max() < 0.006
  floor = Floor(np.array([0, 0, 1.0]), -0.5, 100, 1.0, 0.0)
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
  folder = copied(tum, tmp_path / "tum")
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

  told: list[float] = []

  def located(name, refine_known):
    told.clear()
    return localise(
      tmp_path / "images",
      tmp_path / name,
      known=capture.known,
      settings=dataclasses.replace(FEW, refine_known=refine_known),
      progress=lambda fraction, _: told.append(fraction),
    )

  plain, refined = located("plain", False), located("refined", True)
  assert "adjusted" in refined.strategy and "adjusted" not in plain.strategy
  assert told == sorted(told) and sum(fraction >= 0.5 for fraction in told) >= 6
  assert refined.registered_fraction == 1.0 and refined.reprojection_error_px < 1.0
  for after, before in zip(off(refined), off(plain), strict=True):
    assert after < 0.5 * before
  kept = refined.unit_from_source.inverse().apply_pose(refined.world_from_camera)[5]
  np.testing.assert_allclose(kept, capture.known.world_from_camera[5], atol=1e-6)


def _resize(folder, about, factor):
  """Writes the lengths of a transforms.json multiplied, as structure from motion has them."""
  frames = []
  for frame in about["frames"]:
    matrix = np.array(frame["transform_matrix"])
    matrix[:3, 3] *= factor
    frames.append(frame | {"transform_matrix": matrix.tolist()})
  (folder / "transforms.json").write_text(json.dumps(about | {"frames": frames}))


@pytest.mark.parametrize("factor", [0.3, 4.1])
def test_depth_decides_the_metre_of_poses_of_another_size(tmp_path, factor):
  _resize(tmp_path, write_transforms(tmp_path), factor)
  capture = read_capture(tmp_path, tmp_path / "images", settings=SETTINGS)
  known = capture.known
  numbers = [int(path.stem.split("_")[1]) for path in capture.images]
  np.testing.assert_allclose(known.world_from_camera[:, :3, 3], POSES[numbers, :3, 3], rtol=0.01)
  np.testing.assert_allclose(known.world_from_camera[:, :3, :3], POSES[numbers, :3, :3], atol=1e-9)
  assert known.depth_unit == 1e-3 and np.percentile(off_the_planes(known.points), 90) < 0.02
  said = [text for text in capture.warnings if "So depth decides the metre" in text]
  assert len(said) == 1 and f"multiplied by {1 / factor:.1f}" in said[0]


def test_depth_in_a_listed_unit_leaves_metric_poses(tmp_path):
  write_transforms(tmp_path)
  pictures(tmp_path, "rgb/{:03d}.png", "depth/{:03d}.png", 1 / 5000)
  capture = read_capture(tmp_path, tmp_path / "images", settings=SETTINGS)
  check(capture)
  assert capture.known.depth_unit == 1 / 5000
