"""Tests of how certain places are."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.checks import certainty
from nerf2real.scenes.poses.mapping import registered


@pytest.fixture
def model(folder):
  return pycolmap.Reconstruction(str(folder / "out" / "sfm"))


def _leave_a_spot(model, image, radius):
  """Leaves an image the points nearest to the middle of all that it sees."""
  places = np.array([point.xy for point in image.points2D if point.has_point3D()])
  middle = np.median(places, axis=0)
  for k, point in enumerate(image.points2D):
    if point.has_point3D() and np.linalg.norm(point.xy - middle) > radius:
      model.delete_observation(image.image_id, k)


def test_places_of_pictures_that_see_the_room_are_used(model):
  assert len(certainty.turns(model)) >= 6
  assert certainty.drop_uncertain(model) == ([], [])
  assert model.num_reg_images() == 8


def test_a_place_that_hangs_on_a_spot_is_not_used(model):
  image = registered(model)[4]
  before = certainty.turns(model)[image.image_id]
  _leave_a_spot(model, image, 25.0)
  assert image.num_points3D > 10
  assert certainty.turns(model)[image.image_id] > 5 * before
  assert certainty.drop_uncertain(model, least=8) == ([], [image.name])
  assert image.has_pose
  assert certainty.drop_uncertain(model, least=7) == ([image.name], [])
  assert not image.has_pose and model.num_reg_images() == 7
  assert certainty.drop_uncertain(model) == ([], [])  # of those that are left


def test_fewer_points_are_less_certain(model):
  image = registered(model)[4]
  before = certainty.turns(model)[image.image_id]
  seen = [k for k, point in enumerate(image.points2D) if point.has_point3D()]
  for k in np.random.default_rng(0).permutation(seen)[: 3 * len(seen) // 4]:
    model.delete_observation(image.image_id, int(k))
  # Twice as uncertain of its points, which are as uncertain of the frame as they were.
  assert 1.2 * before < certainty.turns(model)[image.image_id] < 2.2 * before
