"""Plain pixels behind what other views have found flat: put onto it; textured ones stay."""

import dataclasses

import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry.corrections import seen_through
from tests.scenes import furnished_room

BEHIND = 0.3  # m


@pytest.fixture(scope="module")
def views():
  """Five plain views of the north wall, the last of which has a part of its depth behind it."""
  poses = [furnished_room.look_at([x, -0.5, 1.3], [0, 2, 1.3]) for x in (-0.8, -0.4, 0, 0.4, 0.8)]
  camera = cameras.Camera.from_vertical_fov(0.9, 160, 120)
  true = furnished_room.depth_views(np.array(poses), camera)
  true = dataclasses.replace(true, color=np.full((*true.depth.shape, 3), 150, np.uint8))
  wrong = true.depth.copy()
  wrong[-1, 40:80, 50:110] += BEHIND
  return true, dataclasses.replace(true, depth=wrong)


def _flat(views, count):
  """The pixels of the first views of a count are those that were put onto a plane."""
  return np.arange(len(views.depth))[:, None, None] < np.full(views.depth.shape, count)


def test_plain_depth_behind_a_wall_is_the_wall(views):
  true, wrong = views
  found = seen_through.closed(wrong, _flat(true, 4))
  assert np.abs(found.depth - true.depth).max() < 0.05
  assert np.array_equal(found.depth[:-1], true.depth[:-1])


def test_two_views_are_no_agreement(views):
  true, wrong = views
  assert np.array_equal(seen_through.closed(wrong, _flat(true, 2)).depth, wrong.depth)


def test_texture_shows_that_there_is_no_wall(views):
  true, wrong = views
  color = true.color.copy()
  color[-1] += np.random.default_rng(0).integers(0, 60, color[-1].shape).astype(np.uint8)
  textured = dataclasses.replace(wrong, color=color)
  assert np.array_equal(seen_through.closed(textured, _flat(true, 4)).depth, wrong.depth)


def test_what_stands_before_a_wall_stays(views):
  true, _ = views
  near = true.depth.copy()
  near[-1, 40:80, 50:110] -= BEHIND
  before = dataclasses.replace(true, depth=near)
  assert np.array_equal(seen_through.closed(before, _flat(true, 4)).depth, near)


def test_without_anything_flat_all_stays(views):
  _, wrong = views
  assert np.array_equal(seen_through.closed(wrong, _flat(wrong, 0)).depth, wrong.depth)


@pytest.mark.parametrize("nothing", [np.inf, np.nan])
def test_pixels_without_depth_stay_without(views, nothing):
  true, wrong = views
  depth = wrong.depth.copy()
  depth[:, 10:20, 10:20] = nothing
  flat = _flat(true, 4) & np.isfinite(depth)
  found = seen_through.closed(dataclasses.replace(wrong, depth=depth), flat)
  assert not np.isfinite(found.depth[:, 10:20, 10:20]).any()
  assert np.abs(found.depth - true.depth)[-1, 40:80, 50:110].max() < 0.05


def test_depth_without_colours_is_refused(views):
  _, wrong = views
  with pytest.raises(ValueError, match="no colours"):
    seen_through.closed(dataclasses.replace(wrong, color=None), _flat(wrong, 4))
