"""When stereo is made: of few pictures without measured depth."""

from typing import Any

import pytest

from nerf2real.scenes.stages import radiance_field
from nerf2real.scenes.stages.cache import Stages
from nerf2real.scenes.stereo.dense import StereoSettings
from tests.scenes import box_views


class _Pictures:
  """Eight pictures of a box, of which one is held out; counts how often they are read."""

  held_out_every, width, measured = 8, 64, False

  def __init__(self):
    self.all = box_views.make_views(8, width=64, height=48, anchors=100)
    self.read = 0
    poses = type("Poses", (), {"names": self.all.names})()
    self.poses: Any = type("Made", (), {"value": poses, "stamp": "here"})()

  def training(self):
    self.read += 1
    return self.all.split(self.held_out_every)[0]


@pytest.mark.parametrize(("most", "measured", "read"), [(7, False, 1), (6, False, 0), (7, True, 0)])
def test_stereo_is_made_of_few_pictures_without_measured_depth(tmp_path, most, measured, read):
  pictures: Any = _Pictures()
  pictures.measured = measured
  cache = Stages(tmp_path, show_progress=False)
  settings = StereoSettings(most_pictures=most)
  points = radiance_field.stereo(cache, pictures, settings).value
  assert points.shape[1] == 4
  assert pictures.read == read
  if not read:
    assert not len(points)
