"""Figures against the truth of the built-in room."""

from types import SimpleNamespace

import numpy as np

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.builtin import ground_truth, room
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.tracks import Tracks


def test_the_judge_finds_hardly_a_fault_in_the_true_surface():
  points = room.builtin().surface(400)[0]
  points = points[points[:, 2] < 0.8]
  poses = ground_truth.robot_poses(6)
  seen = [(v, p) for v in range(len(poses)) for p in range(len(points))]
  view, point = np.array(seen).T
  found = Localisation(
    camera=ground_truth.robot_camera(480, 640),
    names=tuple(f"{k}.jpg" for k in range(len(poses))),
    world_from_camera=poses,
    points=points,
    point_colors=np.zeros((len(points), 3), np.uint8),
    point_errors=np.full(len(points), 0.5),
    reprojection_error_px=0.5,
    registered_fraction=1.0,
    strategy="none",
    unit_from_source=None,
    tracks=Tracks(view, point, np.zeros((len(view), 2))),
  )
  result = SimpleNamespace(
    localisation=found,
    held_out=np.arange(len(poses)) < 3,
    alignment=SimpleNamespace(world_from_unit=Similarity()),
    collision_top=1.0,
  )
  figures = ground_truth._judge_figures(result, Similarity(), room.builtin())
  assert figures["points_missed_by_truth"] == 0  # they lie on it
  assert 0 < figures["sight_lines_blocked_by_truth"] < 1  # some lie behind furniture
  result.held_out[:] = False
  assert ground_truth._judge_figures(result, Similarity(), room.builtin()) == {}
