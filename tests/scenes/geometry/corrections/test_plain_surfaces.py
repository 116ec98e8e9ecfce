"""Depth that sags where a picture is plain: put onto planes; all else stays."""

import dataclasses

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.geometry.corrections import plain_surfaces
from tests.scenes import furnished_room

SAG = 0.3  # m, where a plain region is deepest


def _sag(wrong):
  """How far depth [H, W] is behind the surface where it is wrong: most far from where it is not."""
  inside = cv2.distanceTransform(wrong.astype(np.uint8), cv2.DIST_L2, 5)
  return SAG * (1 - np.exp(-((inside / 15) ** 2)))


def _filmed(pose, plain, sags=None):
  """A view with true depth, the same sagging away from texture, and its pixels that are plain.

  Args:
    pose: Of the camera [4, 4].
    plain: Tells of points [..., 3] whether the room is plain there; elsewhere it has waves.
    sags: The same of points whose depth is wrong; the plain ones for None.
  """
  camera = cameras.Camera.from_vertical_fov(0.9, 320, 240)
  views = furnished_room.depth_views(pose[None], camera)
  points = pose[:3, 3] + (camera.rays() @ pose[:3, :3].T) * views.depth[0, ..., None]
  phases = points @ np.array([[61, 17, -23], [-29, 53, 31], [25, 25, -40.0]]).T
  flat = plain(points)
  grey = np.where(flat, 150, 120 + 25 * np.sin(phases).sum(-1))
  colour = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[None, ..., None], 3, -1)
  true = dataclasses.replace(views, color=colour)
  wrong = flat if sags is None else sags(points)
  depth = true.depth + _sag(wrong)
  return true, dataclasses.replace(true, depth=depth.astype(np.float32)), flat


def _on(lower, upper):
  """Tells of points whether they lie in a box."""
  return lambda points: ((points > np.array(lower)) & (points < np.array(upper))).all(-1)


NORTH = _on([-1.2, 1.95, 0.5], [0.2, 2.1, 2.1])
NEAR = _on([-0.6, 1.95, 1.0], [-0.1, 2.1, 1.5])
CORNER = _on([1.6, 1.2, 1.0], [2.6, 2.1, 2.2])
TOP = _on([0.7, 0.65, 0.74], [1.7, 1.35, 0.76])


@pytest.mark.parametrize(
  ("plain", "position", "target"),
  [
    (NORTH, [-0.3, -1.2, 1.2], [-0.5, 2.0, 1.3]),
    (NORTH, [1.4, -0.4, 1.5], [-0.5, 2.0, 1.3]),
    (CORNER, [0.0, -0.6, 1.3], [2.3, 1.8, 1.6]),
    (TOP, [0.4, -0.6, 1.6], [1.2, 1.0, 0.7]),
  ],
  ids=["wall", "wall_from_aside", "corner", "table_top"],
)
def test_plain_surfaces_are_flat(plain, position, target):
  true, sagging, flat = _filmed(furnished_room.look_at(position, target), plain)
  found = plain_surfaces.on_planes(sagging)
  before, after = (np.abs(v.depth - true.depth)[0, flat] for v in (sagging, found))
  assert np.mean(before > 0.05) > 0.5
  assert np.mean(after < 0.02) > 0.9
  assert np.abs(found.depth - sagging.depth)[0, ~flat].max() == 0


def test_a_wall_is_flat_behind_a_thing_in_front():
  """The box hides a part of the lower border of the wall's plain part."""
  wall = _on([-1.6, -2.1, -0.1], [0.4, -1.95, 1.2])
  pose = furnished_room.look_at([-0.9, 0.6, 0.9], [-0.8, -2.0, 0.6])
  true, sagging, flat = _filmed(pose, wall)
  found = plain_surfaces.on_planes(sagging)
  assert np.mean(np.abs(found.depth - true.depth)[0, flat] < 0.02) > 0.9


def test_a_border_on_one_side_tells_nothing_of_the_other():
  pose = furnished_room.look_at([-0.3, -1.2, 1.2], [-0.5, 2.0, 1.3])
  _, sagging, flat = _filmed(pose, lambda points: points[..., 2] > 0.7)
  assert flat.mean() > 0.5
  assert np.array_equal(plain_surfaces.on_planes(sagging).depth, sagging.depth)


def test_a_plain_thing_before_a_textured_room_stays_where_it_is():
  """All around it the room is farther: where its own border lies nothing tells."""
  front = _on([-2.15, 0.05, 0.05], [-2.05, 1.15, 1.85])
  pose = furnished_room.look_at([1.2, 0.5, 1.2], [-2.3, 0.6, 0.9])
  _, sagging, flat = _filmed(pose, front)
  assert flat.sum() > 3000
  assert np.array_equal(plain_surfaces.on_planes(sagging).depth, sagging.depth)


def _facing(depth, plain):
  """A view of a textured wall 3 m away, with depth [H, W] and a plain part [H, W] that sags."""
  camera = cameras.Camera.from_vertical_fov(0.9, 320, 240)
  pose = furnished_room.look_at([0, -3, 1.2], [0, 0, 1.2])
  waves = 120 + 25 * np.sin(np.arange(320) * 1.1) + 25 * np.sin(np.arange(240) * 0.9)[:, None]
  grey = np.where(plain, 150, waves).astype(np.uint8)
  return fusion.DepthViews(
    camera=camera,
    frame_from_camera=pose[None],
    depth=np.where(plain, 3.0 + _sag(plain), depth).astype(np.float32)[None],
    color=np.repeat(grey[None, ..., None], 3, -1),
  )


def test_what_is_nearer_says_nothing():
  """Clutter of no plane stands before most of the plain part's border."""
  plain = np.zeros((240, 320), bool)
  plain[60:180, 100:220] = True
  rows, columns = np.mgrid[:240, :320]
  clutter = 1.5 + 0.2 * np.sin(rows / 9) + 0.2 * np.sin(columns / 7)
  wall = (rows < 100) & (columns < 140)
  found = plain_surfaces.on_planes(_facing(np.where(wall, 3.0, clutter), plain))
  assert np.abs(found.depth[0, 64:176, 104:216] - 3.0).max() < 0.02


def test_depth_between_an_edge_and_what_is_behind_it_says_nothing():
  """A plate whose rim of two pixels is textured; depth runs from it to a wall two metres behind."""
  plain = np.zeros((240, 320), bool)
  plain[60:180, 100:220] = True
  outside = cv2.distanceTransform((~plain).astype(np.uint8), cv2.DIST_C, 3)
  found = plain_surfaces.on_planes(_facing(np.interp(outside, [2, 5], [3.0, 5.0]), plain))
  assert np.abs(found.depth[0, 64:176, 104:216] - 3.0).max() < 0.02


def test_textured_surfaces_stay_where_they_are():
  pose = furnished_room.look_at([-0.3, -1.2, 1.2], [-0.5, 2.0, 1.3])
  _, sagging, _ = _filmed(pose, lambda points: np.zeros(points.shape[:-1], bool), NORTH)
  assert np.array_equal(plain_surfaces.on_planes(sagging).depth, sagging.depth)


def test_depth_without_colours_is_refused():
  view, _, _ = _filmed(furnished_room.look_at([0, 0, 1.2], [0, 2, 1.2]), NORTH)
  with pytest.raises(ValueError, match="no colours"):
    plain_surfaces.on_planes(dataclasses.replace(view, color=None))


@pytest.mark.parametrize("nothing", [np.inf, np.nan])
def test_pixels_without_depth_stay_without(nothing):
  """The wall is nearer than the farthest that a pixel is moved."""
  true, sagging, flat = _filmed(furnished_room.look_at([-0.3, 1.2, 1.2], [-0.5, 2.0, 1.3]), NEAR)
  depth = sagging.depth.copy()
  depth[0, 110:130, 150:170] = nothing
  found = plain_surfaces.on_planes(dataclasses.replace(sagging, depth=depth))
  assert flat[110:130, 150:170].all()
  assert not np.isfinite(found.depth[0, 110:130, 150:170]).any()
  others = flat & np.isfinite(depth[0])
  assert np.mean(np.abs(found.depth - true.depth)[0, others] < 0.02) > 0.9
