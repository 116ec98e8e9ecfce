"""Tests of the agreement of pictures' matches with their places."""

import itertools

import cv2
import numpy as np
import pycolmap
import pytest

from nerf2real.core.similarity import Similarity
from nerf2real.scenes.capture.media.stills import list_images
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.localisation import poses_of
from nerf2real.scenes.poses.mapping import registered
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from nerf2real.scenes.poses.work import prepare_work
from tests.scenes import synthetic_capture as synthetic


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
  """Eight pictures of a textured corner: their folder, and the true poses."""
  folder = tmp_path_factory.mktemp("corner")
  poses = synthetic.walk(8)
  synthetic.write_images(folder / "images", poses)
  few = LocaliseSettings(features=FeatureSettings(few_num_features=800))
  localise(folder / "images", folder / "out", settings=few)
  return folder, poses


@pytest.fixture
def model(corner):
  return pycolmap.Reconstruction(str(corner[0] / "out" / "sfm"))


def _again(model, corner):
  folder, _ = corner
  database = folder / "out" / "work" / "database.db"
  return agreement.place_again(model, database, folder / "images", seed=0)


def _shares(model, corner):
  return _shares_of(model, corner[0] / "out" / "work" / "database.db")


def _shares_of(model, database):
  return {key: said.share for key, said in agreement.evidence(model, database).items()}


def _off(model, truth):
  found = poses_of(registered(model))[:, :3, 3]
  return np.linalg.norm(
    Similarity.fit(found, truth[:, :3, 3]).apply(found) - truth[:, :3, 3], axis=1
  )


def _leave_few_points(model, image, count):
  seeing = [k for k, p in enumerate(image.points2D) if p.has_point3D()]
  for k in seeing[count:]:
    model.delete_observation(image.image_id, k)


def test_matches_agree_with_right_places(model, corner):
  shares = _shares(model, corner)
  assert len(shares) == 8
  assert min(shares.values()) > 0.7
  assert _again(model, corner) == (model, 0)


def test_a_wrong_place_is_found_anew(model, corner):
  _, truth = corner
  right = _off(model, truth)
  image = registered(model)[-1]
  pose = image.cam_from_world()
  shifted = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.2, 0.0, 0.1]))
  image.frame.set_cam_from_world(image.camera_id, shifted)
  _leave_few_points(model, image, 30)
  assert _shares(model, corner)[image.image_id] < agreement.MAJORITY
  assert _off(model, truth).max() > 10 * right.max()
  found, placed = _again(model, corner)
  assert placed == 1
  assert _off(found, truth).max() < 0.004  # unadjusted yet; it was off by a twentieth of the walk
  assert _shares(found, corner)[image.image_id] > 0.7
  # All others stay.
  for one in registered(found)[:-1]:
    same = model.images[one.image_id].cam_from_world().matrix()
    np.testing.assert_allclose(one.cam_from_world().matrix(), same, atol=1e-9)


def test_a_picture_without_a_place_gets_one(model, corner):
  _, truth = corner
  model.deregister_frame(registered(model)[3].frame_id)
  found, placed = _again(model, corner)
  assert placed == 1
  assert found.num_reg_images() == 8
  assert _off(found, truth).max() < 0.004


def test_a_picture_of_something_else_stays_without_a_place(corner, tmp_path):
  _, poses = corner
  synthetic.write_images(tmp_path / "images", poses)
  noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
  cv2.imwrite(str(tmp_path / "images" / "zz.png"), noise)
  few = LocaliseSettings(
    features=FeatureSettings(few_num_features=800), min_registered=8, min_fraction=0.8
  )
  result = localise(tmp_path / "images", tmp_path / "out", settings=few)
  assert "zz.png" not in result.names
  assert len(result.names) == 8


@pytest.fixture(scope="module")
def alike(tmp_path_factory):
  """Pictures of a corner with two pictures alike, six at each: folder and true poses.

  The first six see the first of the two, the others the second.
  """
  folder = tmp_path_factory.mktemp("alike")
  ways = np.linspace(-0.3, 0.3, 6)
  first = [synthetic.look_at(np.array([1.0 + k, 1.3, 1.1]), np.array([1.2, 3, 1.0])) for k in ways]
  moved = np.linalg.inv(synthetic.FIRST_FROM_SECOND)
  poses = np.stack([*first, *(moved @ pose for pose in first)])
  synthetic.write_images(folder / "images", poses, synthetic.TWO_ALIKE)
  return folder, poses


@pytest.fixture(scope="module")
def alike_matched(alike):
  """A model of the true poses, and its database."""
  folder, poses = alike
  names = [path.name for path in list_images(folder / "images")]
  database = prepare_work(folder / "images", folder / "work", names, LocaliseSettings(), None)
  features.extract_features(database, folder / "images", names, settings=FeatureSettings())
  pairs = list(itertools.combinations(range(len(names)), 2))
  features.match_pairs(database, pairs, settings=FeatureSettings(), seed=0)
  known = KnownPoses(
    kind="transforms",
    camera=synthetic.CAMERA,
    files=(),
    world_from_camera=poses,
    points=np.zeros((0, 3)),
    point_colors=np.zeros((0, 3), np.uint8),
    point_errors=np.zeros(0),
  )
  return mapping.triangulate(database, folder / "images", known, names), database


def _mistake(model, database, image):
  """Moves a picture of the first of two alike to before the second, with what it sees of it."""
  for k, point in enumerate(image.points2D):
    if point.has_point3D():
      model.delete_observation(image.image_id, k)
  second = [i.image_id for i in registered(model)[6:]]
  for ids, matches, points in agreement.matched_points(model, database):
    if image.image_id in ids and set(ids) & set(second):
      own = ids.index(image.image_id)
      for feature, point in zip(matches[:, own], points[:, 1 - own], strict=True):
        if point and not image.points2D[feature].has_point3D():
          model.add_observation(point, pycolmap.TrackElement(image.image_id, int(feature)))
  move = np.linalg.inv(synthetic.FIRST_FROM_SECOND)
  pose = move @ np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
  image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
  return image


def test_of_two_things_alike_the_area_decides(alike, alike_matched):
  truth, database = alike_matched
  images_folder = alike[0] / "images"
  assert min(_shares_of(truth, database).values()) > 0.7
  model = pycolmap.Reconstruction(truth)
  image = _mistake(model, database, registered(model)[2])
  count = image.num_points3D
  assert count > 0.5 * registered(truth)[2].num_points3D  # by count the wrong place is a good one
  assert _shares_of(model, database)[image.image_id] < agreement.MAJORITY
  found, placed = agreement.place_again(model, database, images_folder, seed=0)
  assert placed == 1
  pose = registered(found)[2].cam_from_world().matrix()
  np.testing.assert_allclose(pose, registered(truth)[2].cam_from_world().matrix(), atol=0.01)


def test_a_picture_for_which_no_better_place_is_found_keeps_its_own(
  alike, alike_matched, monkeypatch
):
  truth, database = alike_matched
  monkeypatch.setattr(agreement, "MAJORITY", 0.995)  # right places are asked for too much
  assert min(_shares_of(truth, database).values()) < 0.995
  found, _ = agreement.place_again(
    pycolmap.Reconstruction(truth), database, alike[0] / "images", seed=0
  )
  assert found.num_reg_images() == truth.num_reg_images()
  for one, same in zip(registered(found), registered(truth), strict=True):
    moved = one.projection_center() - same.projection_center()
    assert np.linalg.norm(moved) < 0.02
