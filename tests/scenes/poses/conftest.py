"""A small capture, localised once for several files."""

import pytest

from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.settings import LocaliseSettings
from nerf2real.scenes.poses.structure_from_motion import localise
from tests.scenes import synthetic_capture as synthetic


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
  """Eight pictures of a textured corner, localised."""
  folder = tmp_path_factory.mktemp("corner")
  synthetic.write_images(folder / "images", synthetic.walk(8))
  few = LocaliseSettings(features=FeatureSettings(few_num_features=800))
  localise(folder / "images", folder / "out", settings=few)
  return folder
