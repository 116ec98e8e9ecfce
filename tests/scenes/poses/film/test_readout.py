"""Rolling shutter: the readout time of a made film, taken out of its observations."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.posed.colmap_model import to_colmap
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.film.readout import doubt, frame_period, motion, take_out

CAMERA = Camera(width=640, height=360, fx=500.0, fy=500.0, cx=320.0, cy=180.0)
PICTURES, PERIOD = 16, 0.2


def pose_at(time):
  """A walk through a room that turns as it goes: world from camera."""
  turn = Rotation.from_rotvec(np.multiply.outer(np.radians(25) * time, [0.0, 1.0, 0.0]))
  return turn, np.stack([0.6 * np.sin(0.8 * time), 0.05 * np.sin(3 * time), 0.5 * time], -1)


def filmed(readout, *, noise=0.0, seed=0):
  """A localised model whose observations were read line by line, and its times."""
  rng = np.random.default_rng(seed)
  points = rng.uniform([-5, -1.5, -5], [5, 1.5, 6], (900, 3))
  model = pycolmap.Reconstruction()
  model.add_camera_with_trivial_rig(to_colmap(CAMERA))
  times, tracks = {}, [pycolmap.Track() for _ in points]
  for number in range(PICTURES):
    name, time = f"{number:02d}.png", number * PERIOD
    times[name] = time
    turn, place = pose_at(time)
    instants, ahead = np.zeros(len(points)), np.ones(len(points), bool)
    for _ in range(6):
      turned, moved = pose_at(time + instants * readout)
      local = turned.inv().apply(points - moved)
      ahead &= local[:, 2] > 0.3
      pixels = CAMERA.project(np.where(ahead[:, None], local, 1.0))
      instants = np.clip(pixels[:, 1] / CAMERA.height - 0.5, -0.5, 0.5)
    seen = np.flatnonzero(ahead & (pixels > 0).all(1) & (pixels < [640, 360]).all(1))
    pixels = pixels[seen] + noise * rng.standard_normal((len(seen), 2))
    matrix = np.hstack([turn.inv().as_matrix(), -turn.inv().apply(place)[:, None]])
    image = pycolmap.Image(name=name, camera_id=1, image_id=number + 1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix))
    for row, k in enumerate(seen):
      tracks[k].add_element(number + 1, row)
  for point, track in zip(points, tracks, strict=True):
    if track.length() >= 3:
      model.add_point3D(point, track, np.zeros(3, np.uint8))
  return model, times


LENS = {"principal": False, "distortion": False}
FIXED = {**LENS, "longest": 0.034}
ADJUST = functools.partial(mapping.adjust, **LENS)


@pytest.mark.parametrize("readout", [0.02, -0.012, 0.0])
def test_the_readout_time_is_found(readout):
  model, times = filmed(readout, noise=0.3)
  ADJUST(model)
  model.update_point_3d_errors()
  before = model.compute_mean_reprojection_error()
  corrected, found = take_out(model, times, **FIXED)
  assert found.readout == pytest.approx(readout, abs=2e-3)
  corrected.update_point_3d_errors()
  assert corrected.compute_mean_reprojection_error() < before + 0.01
  assert corrected.compute_mean_reprojection_error() < 0.45  # of noise 0.3 in two directions


def test_the_readout_is_at_most_a_frame_of_the_film():
  model, times = filmed(0.036)
  ADJUST(model)
  for longest, expected in ((0.02, 0.02), (1 / 24, 0.036)):
    found = take_out(model, times, longest=longest, **LENS)[1].readout
    assert found == pytest.approx(expected, abs=2e-3)
    assert (doubt(found, longest) is None) == (longest > expected)
    assert (doubt(-found, longest) is None) == (longest > expected)


def test_the_period_is_that_of_the_films_frames():
  times = {f"frame_{number:06d}.png": 0.5 + number / 24 for number in (9, 3, 60)}
  assert frame_period(times) == pytest.approx(1 / 24)
  assert frame_period(dict.fromkeys(times, 0.0)) is None
  assert frame_period({"frame_000003.png": 0.1}) is None


def test_keyframes_far_apart_say_nothing_of_the_motion():
  model, times = filmed(0.02)
  found = motion(model, {name: 12 * time for name, time in times.items()}, 0.02)
  np.testing.assert_array_equal(found.rotations, 0)


def test_a_point_in_a_camera_does_not_hide_the_readout_time():
  model, times = filmed(0.02, noise=0.3)
  ADJUST(model)
  image = model.images[6]
  seen = next(place.point3D_id for place in image.points2D if place.has_point3D())
  pose = image.cam_from_world().inverse()
  model.points3D[seen].xyz = pose.translation + pose.rotation.matrix() @ [0.0, 0.0, 1e-7]
  corrected, found = take_out(model, times, **FIXED)
  assert found.readout == pytest.approx(0.02, abs=2e-3)
  assert seen not in corrected.points3D


def test_a_readout_that_no_picture_tells_is_none():
  """Its unknown had no equation but its prior now: the matrix was singular."""
  model, times = filmed(0.02, noise=0.3)
  ADJUST(model)
  far = dict(zip(times, 3.0 * np.arange(len(times)), strict=True))
  found = take_out(model, far, longest=0.034, **LENS)[1]
  assert found.readout == pytest.approx(0.0, abs=1e-9)
