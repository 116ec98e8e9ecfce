import dataclasses

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field.photometry import Exposure
from nerf2real.scenes.field.views import BlurPyramid, Views
from tests.scenes import box_views


def test_split_keeps_every_picture_once():
  views = box_views.make_views(17)
  train, held_out = views.split(8)
  assert held_out.names == ("0004", "0012")
  assert sorted(train.names + held_out.names) == sorted(views.names)
  with pytest.raises(ValueError, match="expected at least 8"):
    box_views.make_views(3).split(8)


def test_rays_hit_what_the_picture_shows():
  views = box_views.make_views(2)
  origin, directions = box_views.rays(views, 1)
  distance = box_views.wall_distance(origin, directions)
  color = box_views.wall_color(origin + distance[..., None] * directions)
  np.testing.assert_allclose(255 * color, views.images[1], atol=0.51)


def test_resized_pictures_keep_their_rays():
  views = box_views.make_views(1)
  small = views.resized(16, 12)
  assert small.images.shape == (1, 12, 16, 3)
  center = small.camera.rays()[6, 8]
  around = views.camera.rays()[12:14, 16:18].mean((0, 1))
  np.testing.assert_allclose(center, around, atol=1e-3)


def test_poses_that_are_not_finite_are_refused():
  views = box_views.make_views(2)
  poses = views.world_from_camera.copy()
  poses[1, 0, 3] = np.nan
  with pytest.raises(ValueError, match="not finite"):
    dataclasses.replace(views, world_from_camera=poses)


def test_blur_levels_have_the_variance_they_claim():
  image = np.zeros((1, 128, 128, 3), np.uint8)
  image[:, 60:68, 60:68] = 255
  camera = Camera(width=128, height=128, fx=100.0, fy=100.0, cx=64.0, cy=64.0)
  pyramid = BlurPyramid.build(Views(camera, image, np.eye(4)[None], ("a",)), blur_max=12.0)
  assert pyramid.blurs[0] == 0 and pyramid.blurs[-1] == 12.0 and max(pyramid.factors) > 1
  own = 8**2 / 12  # variance of the square itself
  for level, blur, factor in zip(pyramid.levels, pyramid.blurs, pyramid.factors, strict=True):
    full = cv2.resize(level[0], (128, 128), interpolation=cv2.INTER_LINEAR).astype(float)[..., 0]
    profile = full.sum(0)
    x = np.arange(128) + 0.5
    mean = (profile * x).sum() / profile.sum()
    variance = (profile * (x - mean) ** 2).sum() / profile.sum()
    assert np.sqrt(max(variance - own, 0)) == pytest.approx(blur, rel=0.06, abs=0.1), factor


def test_selecting_keeps_gains_and_anchors_of_the_chosen_pictures():
  views = box_views.make_views(4, anchors=5)
  gains = np.arange(12.0).reshape(4, 3) + 1
  views = dataclasses.replace(views, exposure=Exposure(gains, np.zeros((3, 3))))
  chosen = views.select([3, 1])
  np.testing.assert_array_equal(chosen.exposure.gains, gains[[3, 1]])
  of_three = views.anchors[views.anchors[:, 0] == 3]
  np.testing.assert_array_equal(chosen.anchors[chosen.anchors[:, 0] == 0, 1:], of_three[:, 1:])
  assert set(chosen.anchors[:, 0]) == {0, 1}


def test_evening_out_divides_by_the_gain():
  views = box_views.make_views(2)
  exposure = Exposure(np.array([[2.0] * 3, [1.0] * 3]), np.zeros((3, 3)))
  doubled = dataclasses.replace(views, images=(views.images // 4) * 2, exposure=exposure)
  evened = doubled.evened()
  np.testing.assert_array_equal(evened.images[0], views.images[0] // 4)
  np.testing.assert_array_equal(evened.images[1], (views.images[1] // 4) * 2)
  assert evened.exposure is None and evened.uneven and evened.select([0]).uneven
