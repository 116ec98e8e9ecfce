"""A capture of two things alike, for several files."""

import itertools

import numpy as np
import pytest

from nerf2real.scenes.capture.media.stills import list_images
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.work import prepare_work
from tests.scenes import synthetic_capture as synthetic


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
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
