"""A depth sensor beside the pictures' camera is found, and one that is aligned is left alone."""

import types

import cv2
import numpy as np
import pytest

from nerf2real.core.cameras import Camera
from nerf2real.core.similarity import Similarity
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.poses import sensor
from nerf2real.scenes.poses.tracks import Tracks
from nerf2real.scenes.stages import localising
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from tests.scenes import furnished_room

_PICTURES = Camera(width=160, height=120, fx=131.0, fy=131.0, cx=81.0, cy=59.0, k1=0.05, k2=-0.06)
_SENSOR = Camera(width=160, height=120, fx=146.0, fy=146.0, cx=80.0, cy=60.0)
_BESIDE = np.array([0.025, 0.0, 0.0])
_UNIT = 1e-3  # m
_POSES = furnished_room.walk(24)


def _raw(views):
  depth = np.where(np.isfinite(views.depth), views.depth, 0)
  return np.rint(depth / _UNIT).astype(np.uint16)


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
  found = sensor.find_sensor(localised, beside, unit=_UNIT)
  assert found is not None
  assert found.camera.fx == pytest.approx(_SENSOR.fx, rel=0.01)
  # at 2 m, where half a pixel is 7 mm
  place = found.camera.project(np.array([0.0, 0.0, 2.0]) - [found.right, found.below, 0.0])
  truth = _SENSOR.project(np.array([0.0, 0.0, 2.0]) - _BESIDE)
  np.testing.assert_allclose(place, truth, atol=1.0)
  true = _raw(furnished_room.depth_views(_POSES, _PICTURES)) * _UNIT
  off = []
  for depth, wanted in zip(beside, true, strict=True):
    aligned = found.aligned(depth * _UNIT, _PICTURES)
    both = (aligned > 0) & (wanted > 0)
    assert both.mean() > 0.6  # the sensor sees less than the pictures do
    off.append([np.abs(d / wanted - 1)[both].mean() for d in (depth * _UNIT, aligned)])
  before, after = np.mean(off, axis=0)
  assert after < 0.4 * before


def test_aligned_depth_is_left_as_it_is(localised):
  assert sensor.find_sensor(localised, _sensed(_POSES, _PICTURES), unit=_UNIT) is None


def test_few_points_say_nothing(localised, beside):
  few = types.SimpleNamespace(**vars(localised))
  few.tracks = Tracks(*(column[:300] for column in localised.tracks))
  assert sensor.find_sensor(few, beside, unit=_UNIT) is None


def _made(folder, value, made):
  return Made(value, StageResult(folder, "key", made, 0.0, cached=False))


def test_a_capture_gets_the_depth_that_its_camera_would_have_measured(localised, beside, tmp_path):
  images, depth = [], []
  for row, raw in enumerate(beside):
    images.append(tmp_path / f"frame_{row:06d}.png")
    depth.append(tmp_path / f"{row}.depth.png")
    cv2.imwrite(str(images[-1]), np.zeros((120, 160, 3), np.uint8))
    cv2.imwrite(str(depth[-1]), raw)
  known = KnownPoses(
    kind="rgbd",
    camera=_PICTURES,
    files=tuple(images),
    world_from_camera=_POSES,
    points=np.zeros((0, 3)),
    point_colors=np.zeros((0, 3), np.uint8),
    point_errors=np.zeros(0),
    depth_files=tuple(depth),
    depth_unit=_UNIT,
  ).lifted()
  ones = np.ones(len(images))
  capture = Capture("rgbd", tmp_path, images, 160, 120, ones, ones, None, [], known)
  localised.names = tuple(path.name for path in images)
  cache = Stages(tmp_path / "stages", show_progress=False)
  poses = _made(tmp_path, localised, "poses")
  before = _made(tmp_path, capture, "keyframes")
  after = localising.sensed(cache, before, poses)
  assert after.stamp != before.stamp and "aligned by localised points" in after.value.warnings[0]
  off = [
    np.percentile(furnished_room.distance(made.value.known.points), 90) for made in (before, after)
  ]
  assert off[1] < 0.6 * off[0]
  assert localising.sensed(cache, before, poses).stage.cached
