"""The judge without a truth: what it says of right, shrunken and misplaced geometry."""

import numpy as np
import pytest

from nerf2real.scenes.geometry import convex
from nerf2real.scenes.quality import sight_lines
from tests.scenes import furnished_room

BOXES = {k: v for k, v in furnished_room.FURNITURE.items() if k in ("shelf", "box", "table")}


def _parts(shift=(0.0, 0.0, 0.0), names=tuple(BOXES)):
  signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
  found = [convex.hull(np.add(BOXES[n][0], signs * BOXES[n][1]) + shift) for n in names]
  return [part for part in found if part is not None]


@pytest.fixture(scope="module")
def lines():
  """Lines from two eyes to points on the furniture and the floor that nothing hides."""
  poses = furnished_room.walk(4)
  camera = furnished_room.cameras.Camera(width=48, height=36, fx=30, fy=30, cx=24, cy=18)
  views = furnished_room.depth_views(poses, camera)
  eyes = np.repeat(poses[:, :3, 3], 48 * 36, axis=0).reshape(4, 36, 48, 3)
  found, starts = [], []
  for pose, eye, depth in zip(poses, eyes, views.depth, strict=True):
    lifted = (camera.rays() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    keep = furnished_room.distance(lifted.reshape(-1, 3), BOXES) < 1e-4
    keep |= np.abs(lifted.reshape(-1, 3)[:, 2]) < 1e-4
    found.append(lifted.reshape(-1, 3)[keep])
    starts.append(eye.reshape(-1, 3)[keep])
  return sight_lines.SightLines(np.concatenate(starts), np.concatenate(found))


def test_right_geometry_is_found_right(lines):
  judged = sight_lines.judge_parts(lines, _parts())
  assert judged.lines == len(lines.points) > 500
  assert judged.blocked == 0 and judged.missed < 0.01 and judged.distance_p95 < 0.02
  assert judged.unfit is None


def test_matter_in_seen_free_space_blocks_lines(lines):
  wall = convex.hull(
    np.array([[x, y, z] for x in (0.3, 0.5) for y in (-2, 2) for z in (0, 2.0)], float)
  )
  judged = sight_lines.judge_parts(lines, [*_parts(), wall])
  assert judged.blocked > 0.2 and judged.blocked_p95 > 0.5
  assert "unfit to train in" in judged.unfit and "expected at most 0.1 m" in judged.unfit


def test_missing_matter_is_missed(lines):
  judged = sight_lines.judge_parts(lines, _parts(names=("box",)))
  share = (lines.points[:, 2] > 0.45).mean()  # on the shelf and the table
  assert judged.missed == pytest.approx(share, abs=0.05) and judged.missed > 0.1


def test_the_truth_itself_is_found_right(lines):
  def distance(points):
    return np.minimum(furnished_room.distance(points, BOXES), np.abs(points[:, 2]))

  judged = sight_lines.judge_truth(lines, distance)
  assert judged.blocked < 0.01 and judged.missed == 0


def test_no_line_is_no_figure():
  none = sight_lines.SightLines(np.zeros((0, 3)), np.zeros((0, 3)))
  assert sight_lines.judge_parts(none, _parts()) is None
