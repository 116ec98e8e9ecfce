"""Rolling shutter: the readout time of a made film, its observations and its pictures."""

import functools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.cameras import Camera
from nerf2real.scenes.capture.posed.colmap_model import to_colmap
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping, shutter

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


ADJUST = functools.partial(mapping.adjust, principal=False, distortion=False)


@pytest.mark.parametrize("readout", [0.02, -0.012, 0.0])
def test_the_readout_time_is_found(readout):
  model, times = filmed(readout, noise=0.3)
  ADJUST(model)
  model.update_point_3d_errors()
  before = model.compute_mean_reprojection_error()
  corrected, found = shutter.correct(model, times, ADJUST)
  assert found.readout == pytest.approx(readout, abs=2e-3)
  corrected.update_point_3d_errors()
  assert corrected.compute_mean_reprojection_error() < before + 0.01
  assert corrected.compute_mean_reprojection_error() < 0.45  # of noise 0.3 in two directions


def test_the_readout_time_of_many_keyframes_is_looked_for_in_some_of_them(monkeypatch):
  monkeypatch.setattr(shutter, "_SEARCHED", PICTURES // 2)
  model, times = filmed(0.02, noise=0.3)
  ADJUST(model)
  adjusted = []

  def adjust(part):
    adjusted.append(len(mapping.registered(part)))
    ADJUST(part)

  corrected, found = shutter.correct(model, times, adjust)
  assert found.readout == pytest.approx(0.02, abs=2e-3)
  assert set(adjusted[:-3]) == {PICTURES // 2}
  assert adjusted[-3:] == [PICTURES] * 3
  assert len(mapping.registered(corrected)) == len(mapping.registered(model)) == PICTURES


def seen_while_turning():
  """Returns a motion, a picture of it, and where it shows points: at its middle line, as read."""
  model, times = filmed(0.03)
  found = shutter.motion(model, times, 0.03)
  index = 7
  points = np.array([[x, y, 1.0] for x in (-0.4, 0.1, 0.5) for y in (-0.25, 0.0, 0.28)])
  points *= found.depths[index]
  middle = CAMERA.project(points)
  read = middle
  for _ in range(6):
    read = found.project(points, shutter.instants(read, CAMERA), index, CAMERA)
  return found, index, middle, read


def test_rectified_pictures_show_points_where_the_middle_line_saw_them():
  found, index, middle, read = seen_while_turning()
  assert np.abs(read - middle).max() > 2
  picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
  for x, y in read:
    cv2.circle(picture, (round((x - 0.5) * 16), round((y - 0.5) * 16)), 64, (255,) * 3, -1, 16, 4)
  straight = found.rectify(picture, CAMERA, index)
  for x, y in middle:
    window = straight[round(y) - 8 : round(y) + 8, round(x) - 8 : round(x) + 8, 0].astype(float)
    rows, columns = np.mgrid[:16, :16] + 0.5
    centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
    np.testing.assert_allclose(centre, [x - round(x) + 8, y - round(y) + 8], atol=0.25)


def test_pixels_are_straightened_as_pictures_are():
  found, index, middle, read = seen_while_turning()
  np.testing.assert_allclose(found.straightened(read, CAMERA, index), middle, atol=0.1)


def test_a_picture_held_upright_is_read_along_its_width():
  upright = Camera(width=360, height=640, fx=500.0, fy=500.0, cx=180.0, cy=320.0)
  pixels = np.array([[0.0, 320.0], [180.0, 10.0], [360.0, 600.0]])
  np.testing.assert_allclose(shutter.instants(pixels, upright), [-0.5, 0.0, 0.5])


def test_keyframes_far_apart_say_nothing_of_the_motion():
  model, times = filmed(0.02)
  found = shutter.motion(model, {name: 12 * time for name, time in times.items()}, 0.02)
  np.testing.assert_array_equal(found.rotations, 0)
