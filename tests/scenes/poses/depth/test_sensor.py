"""A depth sensor beside the pictures' camera is found, and one that is aligned is left alone."""

import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.poses.depth import sensor
from nerf2real.scenes.poses.tracks import Tracks
from nerf2real.scenes.stages import localising
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from tests.scenes import furnished_room
from tests.scenes.poses.depth.recordings import UNIT, counts, recorded

_PICTURES = Camera(width=160, height=120, fx=131.0, fy=131.0, cx=81.0, cy=59.0, k1=0.05, k2=-0.06)
_SENSOR = Camera(width=160, height=120, fx=146.0, fy=146.0, cx=80.0, cy=60.0)
_BESIDE = np.array([0.025, 0.0, 0.0])
_POSES = furnished_room.walk(24)


def _raw(views):
  return counts(views.depth)


def _sensed(poses, camera):
  rng = np.random.default_rng(1)
  return _raw(furnished_room.depth_views(poses, camera, noise=0.004, rng=rng))


@pytest.fixture(scope="module")
def beside():
  """What the sensor of its own measures."""
  poses = _POSES.copy()
  poses[:, :3, 3] += _POSES[:, :3, :3] @ _BESIDE
  return _sensed(poses, _SENSOR)


@pytest.fixture(scope="module")
def localised():
  """Points of the room and the pictures that see them, in a frame of half the size."""
  views = furnished_room.depth_views(_POSES, _PICTURES)
  points = views.surface_points(stride=12)[0]
  view, point, pixel = [], [], []
  for row, (pose, depth) in enumerate(zip(_POSES, views.depth, strict=True)):
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = np.flatnonzero((local[:, 2] > 0.2) & (np.abs(local[:, :2]) < local[:, 2:]).all(-1))
    places = _PICTURES.project(local[ahead])
    column, line = np.floor(places).astype(int).T
    inside = (column >= 0) & (column < 160) & (line >= 0) & (line < 120)
    ahead, places, column, line = (part[inside] for part in (ahead, places, column, line))
    seen = np.abs(depth[line, column] - local[ahead, 2]) < 0.02
    view += [row] * int(seen.sum())
    point += ahead[seen].tolist()
    pixel += places[seen].tolist()
  half = Similarity(0.5, np.eye(3), np.zeros(3))
  return types.SimpleNamespace(
    camera=_PICTURES,
    world_from_camera=half.apply_pose(_POSES),
    points=half.apply(points),
    point_errors=np.zeros(len(points)),
    tracks=Tracks(np.array(view), np.array(point), np.array(pixel)),
    unit_from_source=half,
  )


def test_a_sensor_of_its_own_is_found_and_its_depth_aligned(localised, beside):
  found = sensor.find_sensor(localised, beside, unit=UNIT)
  assert found is not None
  assert found.camera.fx == pytest.approx(_SENSOR.fx, rel=0.01)
  # at 2 m, where half a pixel is 7 mm
  place = found.camera.project(np.array([0.0, 0.0, 2.0]) - [found.right, found.below, 0.0])
  truth = _SENSOR.project(np.array([0.0, 0.0, 2.0]) - _BESIDE)
  np.testing.assert_allclose(place, truth, atol=1.0)
  true = _raw(furnished_room.depth_views(_POSES, _PICTURES)) * UNIT
  off = []
  for depth, wanted in zip(beside, true, strict=True):
    aligned = found.aligned(depth * UNIT, _PICTURES)
    both = (aligned > 0) & (wanted > 0)
    assert both.mean() > 0.6  # the sensor sees less than the pictures do
    off.append([np.abs(d / wanted - 1)[both].mean() for d in (depth * UNIT, aligned)])
  before, after = np.mean(off, axis=0)
  assert after < 0.4 * before


def test_aligned_depth_is_left_as_it_is(localised):
  assert sensor.find_sensor(localised, _sensed(_POSES, _PICTURES), unit=UNIT) is None


def test_few_points_say_nothing(localised, beside):
  few = types.SimpleNamespace(**vars(localised))
  few.tracks = Tracks(*(column[:300] for column in localised.tracks))
  assert sensor.find_sensor(few, beside, unit=UNIT) is None


def _made(folder, value, made):
  return Made(value, StageResult(folder, "key", made, 0.0, cached=False))


def _capture(folder, depth, **known):
  """A capture whose pictures come with depth [N, H, W]."""
  black = np.zeros((len(depth), 120, 160, 3), np.uint8)
  return recorded(folder, black, depth, _PICTURES, _POSES, **known)


def _sensed_stage(localised, capture, folder):
  """What the stage makes of it, before and after, and whether a second run finds it done."""
  found = types.SimpleNamespace(**vars(localised))
  found.names = tuple(path.name for path in capture.images)
  cache = Stages(folder / "stages", show_progress=False)
  before, poses = _made(folder, capture, "keyframes"), _made(folder, found, "poses")
  after = localising.sensed(cache, before, poses)
  assert after is before or localising.sensed(cache, before, poses).stage.cached
  return before, after


def _off(capture, share=90):
  return np.percentile(furnished_room.distance(capture.known.points), share)


def test_a_capture_gets_the_depth_that_its_camera_would_have_measured(localised, beside, tmp_path):
  before, after = _sensed_stage(localised, _capture(tmp_path, beside), tmp_path)
  assert after.stamp != before.stamp and "aligned by localised points" in after.value.warnings[0]
  assert _off(after.value) < 0.6 * _off(before.value)


@pytest.fixture(scope="module")
def later():
  """Where a hand has turned the camera when its depth is measured."""
  turn = np.eye(4)
  turn[:3, :3] = Rotation.from_rotvec([0.01, 0.025, 0.0]).as_matrix()
  turn[:3, 3] = 0.01, 0.0, 0.005
  return _POSES @ turn


def test_depth_is_moved_to_when_the_picture_was_taken(localised, later, tmp_path):
  capture = _capture(tmp_path, _sensed(later, _PICTURES), depth_poses=later)
  before, after = _sensed_stage(localised, capture, tmp_path)
  assert not after.value.warnings and after.value.known.picture_from_depth is None
  assert _off(after.value) < 0.5 * _off(before.value)
  true = _raw(furnished_room.depth_views(_POSES, _PICTURES)).astype(float)
  off = []
  for made in (before, after):
    found = np.stack([depth_pictures.read(path) for path in made.value.known.depth_files])
    both = (found > 0) & (true > 0)
    assert both.mean() > 0.9
    off.append((np.abs(found / np.maximum(true, 1) - 1)[both] > 0.05).mean())
  assert off[1] < 0.5 * off[0]  # pixels on the wrong side of an edge


def test_depth_whose_stamps_are_wrong_stays_where_it_is(localised, later, tmp_path):
  """A driver may stamp when a picture arrives, not when it was taken."""
  capture = _capture(tmp_path, _sensed(_POSES, _PICTURES), depth_poses=later)
  before, after = _sensed_stage(localised, capture, tmp_path)
  assert after is before


def test_the_motion_between_depth_and_picture_follows_adjusted_poses(later, tmp_path):
  known = _capture(tmp_path, _sensed(later, _PICTURES), depth_poses=later).known
  moved = known.with_views(_PICTURES, _POSES[::-1])
  np.testing.assert_allclose(moved.picture_from_depth, known.picture_from_depth, atol=1e-9)
  assert len(known.selected([2, 5], _PICTURES).picture_from_depth) == 2
