"""Pictures with depth are laid onto each other's surfaces where that agrees with what they show."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.stages import localising
from nerf2real.scenes.stages.cache import Made, StageResult, Stages
from tests.scenes import furnished_room
from tests.scenes.poses.depth.recordings import UNIT, counts, recorded

_CAMERA = Camera(width=320, height=240, fx=262.0, fy=262.0, cx=161.0, cy=119.0)
_COUNT = 16
_PLAIN_FROM = 0.5  # m above the floor: walls without texture


def _poses():
  """A walk past plain walls."""
  poses = []
  for angle in np.linspace(-1.6, 0.4, _COUNT):
    place = [0.5 * np.cos(angle) - 0.6, 0.5 * np.sin(angle), 1.2 + 0.1 * np.sin(4 * angle)]
    aim = [2.2 * np.cos(angle), 2.2 * np.sin(angle), 0.7]
    poses.append(furnished_room.look_at(place, aim))
  return np.array(poses)


def _texture(points):
  """Grey [...] of points [..., 3]: waves of a hand's width and less."""
  rng = np.random.default_rng(5)
  waves = rng.standard_normal((60, 3))
  waves *= (rng.uniform(10.0, 60.0, 60) / np.linalg.norm(waves, axis=1))[:, None]
  grey = np.cos(points @ waves.T + rng.uniform(0, 6, 60)).sum(axis=-1)
  return np.where(points[..., 2] > _PLAIN_FROM, 128.0, np.clip(128 + 20 * grey, 0, 255))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
  """A recording whose poses err by 15 mm and 0.5 degrees, and its true poses."""
  rng, true = np.random.default_rng(1), _poses()
  views = furnished_room.depth_views(true, _CAMERA, noise=0.002, rng=rng)
  points = _CAMERA.rays() * furnished_room.depth_views(true, _CAMERA).depth[..., None]
  points = np.einsum("nij,nhwj->nhwi", true[:, :3, :3], points) + true[:, None, None, :3, 3]
  grey = [np.repeat(_texture(view)[..., None], 3, axis=-1).astype(np.uint8) for view in points]
  came = true.copy()
  came[:, :3, 3] += 0.015 / np.sqrt(3) * rng.standard_normal((_COUNT, 3))
  turns = Rotation.from_rotvec(np.radians(0.5) / np.sqrt(3) * rng.standard_normal((_COUNT, 3)))
  came[:, :3, :3] = turns.as_matrix() @ came[:, :3, :3]
  folder = tmp_path_factory.mktemp("recording")
  return recorded(folder, grey, counts(views.depth), _CAMERA, came), true


@pytest.fixture(scope="module")
def refined(capture, tmp_path_factory):
  """The stages' cache, and the poses by features."""
  cache = Stages(tmp_path_factory.mktemp("stages"), show_progress=False)
  return cache, localising.poses(cache, _made(capture[0]), LocaliseSettings())


def _made(capture, made="keyframes"):
  return Made(capture, StageResult(capture.folder, "key", made, 0.0, cached=False))


def _to_truth(found, true):
  """What moves the source's frame, which is off by the tracker's errors, onto the true one."""
  places = found.unit_from_source.inverse().apply(found.world_from_camera[:, :3, 3])
  return Similarity.fit(places, true[:, :3, 3], with_scale=False), places


def _errors(found, true):
  """Distances [N] [m] from the true places, in the frame that fits best."""
  to_truth, places = _to_truth(found, true)
  return np.linalg.norm(to_truth.apply(places) - true[:, :3, 3], axis=1)


def test_places_are_better_known_by_surfaces(capture, refined):
  cache, before = refined
  taken, after = localising.aligned(cache, _made(capture[0]), before)
  assert after.value.names == before.value.names
  assert "laid onto each other's surfaces" in after.value.strategy
  errors = [_errors(made.value, capture[1]) for made in (before, after)]
  assert np.sqrt(np.mean(errors[1] ** 2)) < 0.5 * np.sqrt(np.mean(errors[0] ** 2))
  assert np.median(errors[1]) < 0.003
  assert len(after.value.tracks.view) > 500
  assert taken.value.known.depth_unit == UNIT
  points = after.value.unit_from_source.inverse().apply(after.value.points)
  off = furnished_room.distance(_to_truth(after.value, capture[1])[0].apply(points))
  assert np.median(off) < 0.006
  again = localising.aligned(cache, _made(capture[0]), before)
  assert again[1].stage.cached and again[1].stamp == after.stamp


def test_a_sensors_other_metre_goes_into_its_unit(capture, refined):
  """Poses stay metric as they came; depth that is 8 % short agrees with them afterwards."""
  cache, before = refined
  short = dataclasses.replace(capture[0].known, depth_unit=0.92 * UNIT).lifted()
  taken, after = localising.aligned(
    cache, _made(dataclasses.replace(capture[0], known=short), "short"), before
  )
  known = taken.value.known
  assert known.depth_unit == pytest.approx(UNIT, rel=0.02)
  np.testing.assert_allclose(known.sightings, known.lifted().sightings, rtol=1e-12)
  _, places = _to_truth(after.value, capture[1])
  extent = np.ptp(capture[1][:, :3, 3], axis=0).max()
  assert np.ptp(places, axis=0).max() == pytest.approx(extent, rel=0.02)


def test_depth_of_other_pictures_moves_nothing(capture, refined):
  cache, before = refined
  known = capture[0].known
  mixed = dataclasses.replace(known, depth_files=known.depth_files[::-1])
  given = _made(dataclasses.replace(capture[0], known=mixed), "mixed")
  taken, after = localising.aligned(cache, given, before)
  assert after is before and taken is given
  record = json.loads((cache.folder / "aligned" / "aligned.json").read_text())
  assert record["depth_unit"] is None


def test_pictures_without_depth_stay_as_they_are(capture, refined):
  bare = _made(dataclasses.replace(capture[0], known=None))
  assert localising.aligned(refined[0], bare, refined[1]) == (bare, refined[1])


def test_depth_of_a_sensor_of_its_own_moves_nothing(capture, refined, tmp_path):
  """Its place is known to a few millimetres."""
  (tmp_path / "sensor.json").write_text('{"moved": false, "beside": true}')
  given = Made(capture[0], StageResult(tmp_path, "key", "beside", 0.0, cached=False))
  assert localising.aligned(refined[0], given, refined[1]) == (given, refined[1])
