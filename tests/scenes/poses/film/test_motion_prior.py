"""A film's parts that hang together by little are held by how a hand moves."""

import numpy as np
import pytest

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.film import motion_prior
from nerf2real.scenes.poses.mapping import registered
from tests.scenes.poses.film.test_readout import PERIOD, PICTURES, filmed

FIRST = PICTURES // 2  # of the part that comes apart


def database_of(model, path):
  """The features of a model's pictures, without matches."""
  with pycolmap.Database.open(str(path)) as db:
    camera = next(iter(model.cameras.values()))
    db.write_camera(camera, use_camera_id=True)
    for image in registered(model):
      plain = pycolmap.Image(name=image.name, camera_id=1, image_id=image.image_id)
      db.write_image(plain, use_image_id=True)
      pixels = np.array([place.xy for place in image.points2D], np.float32)
      db.write_keypoints(image.image_id, pixels)
  return path


def apart(model, size, shared):
  """Gives a film's second half another size, and points of its own but for some."""
  late = {image.image_id for image in registered(model)[FIRST:]}
  center = registered(model)[FIRST].projection_center()
  for key in sorted(model.points3D):
    position = model.points3D[key].xyz.copy()
    elements = [(e.image_id, e.point2D_idx) for e in model.points3D[key].track.elements]
    halves = [[e for e in elements if (e[0] in late) == second] for second in (False, True)]
    if all(halves) and shared:
      shared -= 1
      continue
    model.delete_point3D(key)
    for half, factor in zip(halves, (1.0, size), strict=True):
      if len(half) >= 2:
        track = pycolmap.Track()
        for element in half:
          track.add_element(*element)
        moved = center + factor * (position - center)
        model.add_point3D(moved, track, np.zeros(3, np.uint8))
  for image in registered(model)[FIRST:]:
    pose = image.cam_from_world()
    place = center + size * (image.projection_center() - center)
    turned = pose.rotation.matrix()
    moved = pycolmap.Rigid3d(pose.rotation, -turned @ place)
    image.frame.set_cam_from_world(image.camera_id, moved)


def off(model, true):
  """The farthest of a model's places from the true ones [N, 3], of their width."""
  places = np.array([image.projection_center() for image in registered(model)])
  found = Similarity.fit(places, true).apply(places)
  return np.linalg.norm(found - true, axis=1).max() / np.ptp(true, axis=0).max()


@pytest.mark.parametrize("size", [0.6, 1.5])
def test_a_part_that_has_come_apart_gets_its_size(tmp_path, size):
  model, times = filmed(0.0, noise=0.3)
  true = np.array([image.projection_center() for image in registered(model)])
  database = database_of(model, tmp_path / "database.db")
  apart(model, size, shared=12)
  assert off(model, true) > 0.05
  held = motion_prior.hold(model, database, times)
  assert off(held, true) < 0.02


def test_places_that_pictures_know_stay(tmp_path):
  model, times = filmed(0.0)
  true = np.array([image.projection_center() for image in registered(model)])
  held = motion_prior.hold(model, database_of(model, tmp_path / "database.db"), times)
  assert off(held, true) < 1e-3
  assert held.num_points3D() > 0.9 * model.num_points3D()


def test_a_film_without_times_that_grow_is_left_alone(tmp_path):
  model, times = filmed(0.0)
  held = motion_prior.hold(model, tmp_path / "none.db", dict.fromkeys(times, 1.0))
  assert held is model


def test_a_camera_that_stands_still_says_nothing_of_a_hand(tmp_path):
  model, times = filmed(0.0)
  for image in registered(model)[:-2]:
    turn = image.cam_from_world().rotation
    image.frame.set_cam_from_world(1, pycolmap.Rigid3d(turn, np.zeros(3)))
  assert motion_prior.hold(model, tmp_path / "none.db", times) is model


def test_roughness_is_by_the_film_s_own_motion():
  times = np.arange(30) * PERIOD
  rng = np.random.default_rng(0)
  velocities = np.cumsum(rng.normal(size=(30, 3)) * 0.2 * np.sqrt(PERIOD), axis=0)
  places = np.cumsum(velocities * PERIOD, axis=0)
  usual, most = motion_prior.roughness(places, times)
  assert usual == pytest.approx(0.2, rel=0.3) and most < 6
  assert motion_prior.roughness(places[:2], times[:2]) == (0.0, 0.0)
  places[15:] += 1.0
  assert motion_prior.roughness(places, times)[1] > 50
  assert motion_prior.roughness(2 * places, times)[1] == pytest.approx(
    motion_prior.roughness(places, times)[1]
  )
