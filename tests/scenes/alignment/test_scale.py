"""Tests of what the metric scale rests on."""

import numpy as np
import pytest

from nerf2real.scenes.alignment import scale
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.floor import Floor
from nerf2real.scenes.alignment.markers import MarkerScale
from nerf2real.scenes.alignment.overrides import Overrides

FLOOR = Floor(np.array([0, 0, 1.0]), 0.0, 100, 1.0, 0.0)


def _chosen(*, assumed, camera_height=None, marker=None, height=2.0):
  poses = np.tile(np.eye(4), (3, 1, 1))
  poses[:, 2, 3] = height  # units above the floor
  evidence = Evidence(
    np.zeros((1, 3)), poses, marker=marker, sensor_scale=1.0, metres_assumed=assumed
  )
  return scale.choose_scale(
    evidence,
    Overrides(),
    floor=FLOOR,
    camera_height=camera_height,
    guessed_camera_height=1.4,
    max_marker_spread=0.05,
  )


@pytest.mark.parametrize(
  ("assumed", "camera_height", "source", "metres"),
  [
    (False, None, "depth_sensor", 1.0),
    (False, 1.5, "depth_sensor", 1.0),
    (True, None, "depth_sensor", 1.0),
    (True, 1.5, "camera_height", 0.75),
  ],
)
def test_a_known_height_comes_before_metres_that_are_assumed(
  assumed, camera_height, source, metres
):
  chosen = _chosen(assumed=assumed, camera_height=camera_height)
  assert (chosen.source, chosen.value.metres_per_unit) == (source, metres)
  said = any("Metres were assumed" in text for text in chosen.warnings)
  assert said == (assumed and camera_height is None)


def test_a_marker_comes_before_any_depth():
  marker = MarkerScale(0.9, 0.004, "4X4_50", (1,), 9, 0.3, np.zeros((1, 4, 3)))
  for assumed in (False, True):
    chosen = _chosen(assumed=assumed, camera_height=1.5, marker=marker)
    assert chosen.source == "marker" and not chosen.warnings


@pytest.mark.parametrize("height", [-1.0, 0.0])
def test_a_floor_above_the_cameras_gives_no_metre(height):
  with pytest.raises(ValueError, match="floor lies above the cameras"):
    _chosen(assumed=True, camera_height=1.5, height=height)
