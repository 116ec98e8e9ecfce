"""Matching along a pair's geometry: things alike at other places do not stand in its way."""

import numpy as np
import pytest

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.matching import guided

COUNT = 200
FOCAL = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
TURN = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
SHIFT = np.array([0.4, 0.1, 0.02])


def _features(places, descriptors):
  length = np.linalg.norm(descriptors, axis=1, keepdims=True)
  return guided.Features(places.astype(np.float32), (descriptors / length).astype(np.float32))


def _geometry(kind):
  """A pair's geometry, and where its points are in both pictures [N, 2]."""
  random = np.random.default_rng(0)
  points = random.uniform((-1, -0.8, 2), (1, 0.8, 5), (COUNT, 3))
  geometry = pycolmap.TwoViewGeometry()
  if kind == "lines":
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    cross = np.cross(np.eye(3), SHIFT)
    inverse = np.linalg.inv(FOCAL)
    geometry.F = inverse.T @ -cross @ TURN @ inverse
    there = points @ TURN.T + SHIFT
  else:  # a turn on the spot
    geometry.config = pycolmap.TwoViewGeometryConfiguration.PANORAMIC
    geometry.H = FOCAL @ TURN @ np.linalg.inv(FOCAL)
    there = points @ TURN.T
  seen = (local @ FOCAL.T for local in (points, there))
  return geometry, *(homogeneous[:, :2] / homogeneous[:, 2:] for homogeneous in seen)


@pytest.mark.parametrize("kind", ["lines", "places"])
def test_things_alike_at_other_places_stand_in_no_ones_way(kind):
  geometry, one, two = _geometry(kind)
  random = np.random.default_rng(1)
  looks = np.repeat(random.uniform(0, 1, (COUNT // 2, 128)), 2, axis=0)  # everything twice
  noise = random.normal(0, 0.02, (2, COUNT, 128))
  order = random.permutation(COUNT)
  pair = _features(one, looks + noise[0]), _features(two[order], (looks + noise[1])[order])
  found = guided.match(*pair, geometry)
  assert found.dtype == np.uint32
  right = order[found[:, 1]] == found[:, 0]
  assert right.all() and len(found) > 0.9 * COUNT
  # without a geometry a twin is as good, and the ratio test drops nearly all
  angles = np.sort(np.arccos(np.clip(pair[0].descriptors @ pair[1].descriptors.T, -1, 1)), axis=1)
  assert (angles[:, 0] < guided.MAX_RATIO * angles[:, 1]).mean() < 0.1


@pytest.mark.parametrize("kind", ["lines", "places"])
def test_what_is_off_its_line_or_place_has_no_match(kind):
  geometry, one, two = _geometry(kind)
  looks = np.random.default_rng(2).uniform(0, 1, (COUNT, 128))
  step = np.array([0.0, 1.0])
  for off, share in ((0.5 * guided.MAX_ERROR, 1.0), (4 * guided.MAX_ERROR, 0.0)):
    found = guided.match(_features(one, looks), _features(two + off * step, looks), geometry)
    assert abs(len(found) / COUNT - share) < 0.05, (off, len(found))


def test_a_pair_without_geometry_has_no_guide():
  _, one, two = _geometry("lines")
  looks = np.ones((COUNT, 128))
  pair = _features(one, looks), _features(two, looks)
  assert guided.match(*pair, pycolmap.TwoViewGeometry()) is None
