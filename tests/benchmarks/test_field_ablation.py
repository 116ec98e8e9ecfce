"""The field's ablation: what stands in pictures is in the share asked for, and in no others."""

import numpy as np

from benchmarks.rooms import field_ablation
from nerf2real.core.cameras import Camera
from nerf2real.scenes.field.views import Views


def test_passers_stand_in_a_share_of_the_pictures():
  camera = Camera.from_vertical_fov(1.0, 64, 48)
  images = np.zeros((40, 48, 64, 3), np.uint8)
  views = Views(camera, images, np.tile(np.eye(4), (40, 1, 1)), tuple(map(str, range(40))))
  painted = field_ablation.with_passers(views, 0.5, 0).images.any((1, 2, 3))
  assert 8 < painted.sum() < 32
  assert not images.any()
