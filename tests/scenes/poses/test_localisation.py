"""Tests of what is known of localised pictures."""

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.localisation import Localisation
from tests.scenes.synthetic_model import NO_TRACKS


def test_overlooking_is_the_keyframe_with_the_most_points_before_its_lens():
  points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (300, 3))
  away, aside = np.eye(4), np.eye(4)
  away[:3, :3] = np.diag([-1, 1, -1])
  aside[0, 3] = 1.5  # sees about half of them
  found = Localisation(
    camera=Camera.from_vertical_fov(np.radians(40), 64, 48),
    names=("away", "aside", "ahead"),
    world_from_camera=np.stack([away, aside, np.eye(4)]),
    points=points,
    point_colors=np.zeros((300, 3), np.uint8),
    point_errors=np.zeros(300),
    reprojection_error_px=0.0,
    registered_fraction=1.0,
    strategy="given",
    unit_from_source=Similarity(),
    tracks=NO_TRACKS,
  )
  assert found.overlooking() == 2
