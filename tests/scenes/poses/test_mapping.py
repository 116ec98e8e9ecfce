"""Tests of adjustments, on made-up places and points."""

import dataclasses

import numpy as np
import pycolmap
import pytest

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses import mapping
from tests.scenes import synthetic_capture as synthetic
from tests.scenes import synthetic_model

WEAK = 3  # the picture that sees little


def observed():
  """A model with noise of a pixel, one picture of which sees six points, and its true places."""
  model = synthetic_model.exact(frames=8, points=120)
  random = np.random.default_rng(0)
  for image in model.images.values():
    for point in image.points2D:
      point.xy = point.xy + random.normal(0, 1, 2)
  true = {image.name: image.projection_center() for image in model.images.values()}
  weak = mapping.registered(model)[WEAK]
  places = np.array([model.points3D[p.point3D_id].xyz for p in weak.points2D])
  near = np.argsort(np.linalg.norm(places - places[0], axis=1))[:6]
  for row in set(range(len(places))) - set(near.tolist()):
    model.delete_observation(weak.image_id, row)
  return model, true


def errors(model, true):
  images = mapping.registered(model)
  found = np.array([image.projection_center() for image in images])
  wanted = np.array([true[image.name] for image in images])
  strong = np.arange(len(images)) != WEAK
  return np.linalg.norm(Similarity.fit(found[strong], wanted[strong]).apply(found) - wanted, axis=1)


def test_anchors_hold_what_sees_little_and_little_else():
  model, true = observed()
  free, held = pycolmap.Reconstruction(model), pycolmap.Reconstruction(model)
  mapping.adjust(free, principal=False, distortion=False)
  shaken = {name: place + 0.01 * np.sin(k) for k, (name, place) in enumerate(true.items())}
  mapping.adjust(held, principal=False, distortion=False, anchors=mapping.Anchors(shaken, 0.03))
  before, after = errors(free, true), errors(held, true)
  assert after[WEAK] < 0.04 < 0.1 < before[WEAK]
  strong = np.arange(len(before)) != WEAK
  np.testing.assert_allclose(after[strong], before[strong], atol=2e-3)


def test_points_in_a_camera_are_dropped_and_no_others():
  model, _ = observed()
  image = mapping.registered(model)[0]
  first, second, *_ = {place.point3D_id for place in image.points2D if place.has_point3D()}
  pose = image.cam_from_world().inverse()
  ahead = pose.rotation.matrix()[:, 2]
  model.points3D[first].xyz = pose.translation + 1e-7 * ahead
  model.points3D[second].xyz = pose.translation - 0.5 * ahead
  before = set(model.points3D)
  mapping.drop_points_in_cameras(model)
  assert before - set(model.points3D) == {first, second}


@pytest.mark.parametrize(
  ("change", "fault"),
  [
    ({}, None),
    ({"k1": 0.06, "k2": -0.09}, None),
    ({"k1": -0.9}, "folds"),
    ({"fx": 215.5, "fy": 215.5, "k1": -0.05, "k2": -0.117}, "folds"),  # grows, but not to a corner
    ({"k1": 1.0, "k2": -1.8}, None),  # folds behind the corners
    ({"k2": -2.0}, "folds"),
    ({"cx": 200.0}, "principal point"),
    ({"fy": 330.0}, "differ"),
  ],
)
def test_absurd_lenses_are_recognised(change, fault):
  camera = dataclasses.replace(synthetic.CAMERA, **change)
  found = mapping.camera_fault(camera)
  assert found is None if fault is None else fault in found
