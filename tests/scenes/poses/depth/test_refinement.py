"""Tests of which refined poses are kept."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.depth import refinement

COUNT = 9
NAMES = [f"picture_{k}.jpg" for k in range(COUNT)]


def known(poses):
  camera = Camera.from_vertical_fov(0.8, 40, 30)
  none = np.zeros((0, 3))
  return KnownPoses(
    kind="rgbd",
    camera=camera,
    files=(),
    world_from_camera=poses,
    points=none,
    point_colors=none.astype(np.uint8),
    point_errors=none[:, 0],
  )


def turned(degrees):
  poses = np.tile(np.eye(4), (COUNT, 1, 1))
  turns = Rotation.from_rotvec(np.radians(degrees)[:, None] * [0.0, 1.0, 0.0])
  poses[:, :3, :3] = turns.as_matrix()
  poses[:, 0, 3] = np.arange(COUNT)
  return poses


class Picture:
  def __init__(self, name, points):
    self.name, self.num_points3D, self.frame_id = name, points, name


@pytest.mark.parametrize(("points", "leaves"), [(30, True), (300, False)])
def test_what_sees_little_and_turns_away_keeps_the_pose_it_came_with(monkeypatch, points, leaves):
  degrees = np.full(COUNT, 0.5)
  degrees[4] = 6.0
  before, after = known(turned(np.zeros(COUNT))), known(turned(degrees))
  pictures = [Picture(name, 200) for name in NAMES]
  pictures[4].num_points3D = points
  gone = []
  monkeypatch.setattr(mapping, "registered", lambda model: pictures)
  model = type("Model", (), {"deregister_frame": lambda self, name: gone.append(name)})()
  kept = refinement._let_go(model, before, after, NAMES).world_from_camera
  assert gone == ([NAMES[4]] if leaves else [])
  expected = after.world_from_camera.copy()
  if leaves:
    expected[4] = before.world_from_camera[4]
  np.testing.assert_array_equal(kept, expected)


def test_places_are_held_by_how_far_they_were_moved():
  before = known(turned(np.zeros(COUNT)))
  moved = before.world_from_camera.copy()
  moved[1:, :3, 3] += np.random.default_rng(0).normal(0, 0.01, (COUNT - 1, 3))
  anchors = refinement._anchors(before, known(moved), NAMES)
  assert anchors.deviation == pytest.approx(0.03, rel=0.4)
  np.testing.assert_array_equal(anchors.positions[NAMES[3]], before.world_from_camera[3, :3, 3])
  assert refinement._anchors(before, before, NAMES).deviation > 0
