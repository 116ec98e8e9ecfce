"""What the training could not help is refused before it."""

import types

import numpy as np
import pytest

from nerf2real.scenes.alignment import overrides, world_frame
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.stages import world_frame as world_frame_stages
from nerf2real.scenes.stages.cache import Made, Stages
from nerf2real.scenes.stages.results import Given
from tests.scenes import furnished_room


def _poses(points):
  poses = furnished_room.walk(12)
  return types.SimpleNamespace(value=_Found(points, poses), stamp="poses")


class _Found(types.SimpleNamespace):
  def __init__(self, points, poses):
    super().__init__(points=points, world_from_camera=poses, names=[], camera=None)


def _floor(rng, height=0.0):
  return np.column_stack([rng.uniform(-2, 2, (2000, 2)), rng.normal(height, 0.002, 2000)])


def _outlook(tmp_path, points, **changes) -> Made:
  return world_frame_stages.outlook(
    Stages(tmp_path / ".stages", show_progress=False),
    types.SimpleNamespace(value=types.SimpleNamespace(known=None, unit_up=None)),
    _poses(points),
    world_frame.AlignSettings(**changes),
    Given(overrides.Overrides(), "", None),
    voxel=0.02,
  )


def test_a_room_with_a_floor_passes_and_is_done_once(tmp_path):
  points = _floor(np.random.default_rng(0))
  made = _outlook(tmp_path, points, camera_height=1.4)
  assert made.value == world_frame_stages.Outlook(None) and not made.stage.cached
  assert _outlook(tmp_path, points, camera_height=1.4).stage.cached


def test_points_without_a_floor_are_warned_of_by_every_run(tmp_path):
  """The field's depth may show a floor that has no texture for localised points."""
  ceiling = _floor(np.random.default_rng(0), height=3.0)
  for cached in (False, True):
    with pytest.warns(UserWarning, match="film the floor"):
      made = _outlook(tmp_path, ceiling)
    assert made.stage.cached == cached
    assert len(made.value.warnings) == 1 and "field's depth" in made.value.warnings[0]


def test_centimetres_for_metres_are_refused(tmp_path):
  points = _floor(np.random.default_rng(0))
  with pytest.raises(ValueError, match="from camera_height: give lengths in metres"):
    _outlook(tmp_path, points, camera_height=140.0)
  for wrong in ({"marker_side": 20.0}, {"align": world_frame.AlignSettings(camera_height=140.0)}):
    with pytest.raises(ValueError, match=r"is in metres: found \d+, expected"):
      SceneSettings(**wrong)
