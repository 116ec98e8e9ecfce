"""Adjusting by the noise that is left, and what goes where patches do not agree."""

import numpy as np
import pycolmap
import pytest

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses import mapping, sharpening
from nerf2real.scenes.poses.matching import patches
from tests.scenes import synthetic_model

NOISE = 0.1  # of most observations [pixel]
LENS = mapping.FreeLens(distortion=False, principal=False, words="")


@pytest.fixture
def observed():
  """A model with a little noise, every eighth observation 0.5 to 2 pixels off, and true places."""
  model = synthetic_model.exact(frames=10, points=150)
  random = np.random.default_rng(0)
  for image in model.images.values():
    for number, point in enumerate(image.points2D):
      shift = random.normal(0, NOISE, 2)
      if number % 8 == 0:
        shift = random.uniform(0.5, 2.0) * np.array([1.0, 0.3])
      point.xy = point.xy + shift
  return model, {image.name: image.projection_center() for image in model.images.values()}


def error(model, true):
  """Root mean square of the positions' errors, times the size of the walk."""
  images = mapping.registered(model)
  found = np.array([image.projection_center() for image in images])
  wanted = np.array([true[image.name] for image in images])
  off = Similarity.fit(found, wanted).apply(found) - wanted
  return np.sqrt((off**2).sum(-1).mean()) / np.linalg.norm(wanted.std(0))


def test_places_are_as_exact_as_most_observations(observed):
  model, true = observed
  mapping.adjust(model, principal=False, distortion=False)
  settled = sharpening.settle(model, LENS)
  assert error(settled, true) < 0.8 * error(model, true)
  best = pycolmap.Reconstruction(model)
  for image in mapping.registered(best):
    for row in range(0, len(image.points2D), 8):
      if image.points2D[row].has_point3D():
        best.delete_observation(image.image_id, row)
  mapping.adjust(best, principal=False, distortion=False)
  assert error(settled, true) < 1.2 * error(best, true)
  settled.update_point_3d_errors()
  assert settled.compute_mean_reprojection_error() < 2 * NOISE
  assert settled.compute_num_observations() > 0.8 * model.compute_num_observations()


def test_detected_features_are_adjusted_as_before(observed):
  """With half a pixel of noise the loss has the scale that it has for detected features."""
  model, true = observed
  random = np.random.default_rng(1)
  for image in model.images.values():
    for point in image.points2D:
      point.xy = point.xy + random.normal(0, 0.6, 2)
  mapping.adjust(model, principal=False, distortion=False)
  settled = sharpening.settle(model, LENS)
  assert error(settled, true) == pytest.approx(error(model, true), rel=0.2)
  assert settled.compute_num_observations() > 0.95 * model.compute_num_observations()


def test_what_is_not_found_goes_but_from_pictures_that_show_little(observed, monkeypatch):
  model, _ = observed
  first, second = (image.image_id for image in mapping.registered(model)[:2])
  before = {i: model.images[i].num_points3D for i in (first, second)}
  many = before[first] - mapping.MIN_OBSERVATIONS
  lost = [patches.Observation(first, row) for row in range(many)]
  lost += [patches.Observation(second, row) for row in range(before[second] - 5)]
  monkeypatch.setattr(patches, "align", lambda *_, **__: lost)
  aligned = sharpening.align(model, None, None)
  assert aligned.images[first].num_points3D == mapping.MIN_OBSERVATIONS
  assert aligned.images[second].num_points3D == before[second]
  assert model.images[first].num_points3D == before[first]


def test_a_picture_does_not_lose_what_another_one_does_not_find(observed, monkeypatch):
  model, _ = observed
  weak, many, *others = (image.image_id for image in mapping.registered(model))
  shared = [p.point3D_id for p in model.images[weak].points2D][: mapping.MIN_OBSERVATIONS + 3]
  for image in (weak, *others):
    for row, place in enumerate(model.images[image].points2D):
      if place.has_point3D() and (image != weak) == (place.point3D_id in shared):
        model.delete_observation(image, row)  # `weak` sees these points alone, with `many`
  rows = [row for row, p in enumerate(model.images[many].points2D) if p.point3D_id in shared]
  assert model.images[weak].num_points3D == mapping.MIN_OBSERVATIONS + 3 == len(rows)
  lost = [patches.Observation(many, row) for row in rows]
  monkeypatch.setattr(patches, "align", lambda *_, **__: lost)
  aligned = sharpening.align(model, None, None)
  assert aligned.images[weak].num_points3D == mapping.MIN_OBSERVATIONS


def test_a_picture_of_few_points_keeps_them_however_far_they_are(observed):
  model, true = observed
  weak = mapping.registered(model)[3]
  for row in range(mapping.MIN_OBSERVATIONS + 2, len(weak.points2D)):
    model.delete_observation(weak.image_id, row)
  random = np.random.default_rng(2)
  for point in weak.points2D:
    point.xy = point.xy + random.normal(0, 1.0, 2)
  mapping.adjust(model, principal=False, distortion=False)
  settled = sharpening.settle(model, LENS)
  assert settled.images[weak.image_id].num_points3D >= mapping.MIN_OBSERVATIONS
  assert error(settled, true) < 0.05
