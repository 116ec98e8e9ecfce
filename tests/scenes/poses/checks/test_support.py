"""Of several models of the same matches the one that joins most of them is taken."""

import numpy as np
import pytest

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.checks import support


def _torn(model):
  """The model in two halves: what both see is points of each half's own."""
  torn = pycolmap.Reconstruction(model)
  half = {image for image in torn.images if image <= len(torn.images) // 2}
  for number, point in list(torn.points3D.items()):
    seen = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in half]
    if 2 <= len(seen) <= len(point.track.elements) - 2:
      for image, feature in seen:
        torn.delete_observation(image, feature)
      track = pycolmap.Track(elements=[pycolmap.TrackElement(*place) for place in seen])
      torn.add_point3D(point.xyz, track, point.color)
      assert number in torn.points3D
  return torn


def test_a_model_in_two_halves_joins_fewer_matches(folder):
  database = folder / "out" / "work" / "database.db"
  whole = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  torn = _torn(whole)
  assert torn.num_reg_images() == whole.num_reg_images()
  assert torn.compute_num_observations() == whole.compute_num_observations()
  assert support.support(torn, database) < 0.9 * support.support(whole, database)
  assert 0.5 < support.support(whole, database) <= 1


@pytest.mark.parametrize(
  ("shares", "places", "taken", "unsure"),
  [
    ((0.83, 0.87, 0.86), (0.0, 0.2, 0.5), 1, 0.2),  # all differ: the best
    ((0.87, 0.86), (0.0, 0.01), 0, 0.01),  # two are the same: no third
    ((0.83, 0.86, 0.87), (0.2, 0.0, 0.01), 2, 0.01),
    ((0.87, 0.83, 0.84), (0.0, 0.2, 0.21), 0, 0.2),  # two are, and another is better
    ((None, 0.5, None), (None, 0.0, None), 1, 0.0),  # an attempt that found nothing
    ((None, None, None), (None, None, None), None, 0.0),
  ],
)
def test_attempts_end_with_two_that_are_the_same(
  monkeypatch, tmp_path, shares, places, taken, unsure
):
  tried = []
  monkeypatch.setattr(support, "support", lambda model, database: shares[model])
  monkeypatch.setattr(support, "apart", lambda one, two: abs(places[one] - places[two]))

  def attempt(number):
    tried.append(number)
    return None if shares[number] is None else number

  best, apart = support.best_supported(attempt, tmp_path, attempts=3, same=0.05)
  assert best == taken and apart == pytest.approx(unsure)
  assert tried == list(range(len(shares)))


def test_one_attempt_is_not_judged(monkeypatch, tmp_path):
  monkeypatch.setattr(support, "support", None)
  assert support.best_supported(lambda number: "model", tmp_path, attempts=1, same=0.05) == (
    "model",
    0.0,
  )


def test_places_of_two_attempts_are_compared_whatever_their_frames(folder):
  one = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  two = pycolmap.Reconstruction(one)
  two.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0, 0, 1, 0.0])), np.ones(3)))
  assert support.apart(one, two) < 1e-6
  assert support.apart(one, pycolmap.Reconstruction()) == 1.0
  image = mapping.registered(two)[3]
  width = np.ptp([i.projection_center() for i in mapping.registered(two)], axis=0).max()
  pose = image.cam_from_world()
  moved = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.2 * width, 0, 0]))
  image.frame.set_cam_from_world(image.camera_id, moved)
  assert 0.1 < support.apart(one, two) < 0.3
