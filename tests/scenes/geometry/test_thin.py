"""A pole before a wall, by rays: fused depth loses it, and pictures' votes bring it back."""

import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.scenes.geometry import collision, fusion, thin

POLE, RADIUS, TOP = np.array([0.1, -0.05]), 0.012, 1.2
WALL = 1.5  # m along y
LOWER, UPPER = np.array([-0.6, -0.6, 0.0]), np.array([0.6, 0.6, 1.4])
CAMERA = cameras.Camera.from_vertical_fov(0.75, 160, 120)


def _depth(pose: np.ndarray, *, pole: bool) -> np.ndarray:
  """Depth picture [H, W] of the wall, the floor and, where asked for, the pole."""
  eye, ways = pose[:3, 3], CAMERA.rays() @ pose[:3, :3].T
  depth = (WALL - eye[1]) / np.maximum(ways[..., 1], 1e-6)
  floor = -eye[2] / np.minimum(ways[..., 2], -1e-6)
  depth = np.minimum(depth, floor)
  if pole:
    offset = eye[:2] - POLE
    a = np.square(ways[..., :2]).sum(-1)
    b = ways[..., :2] @ offset
    root = b * b - a * (offset @ offset - RADIUS**2)
    near = (-b - np.sqrt(np.maximum(root, 0))) / a
    hit = (root > 0) & (eye[2] + near * ways[..., 2] < TOP)
    depth = np.where(hit, np.minimum(near, depth), depth)
  return depth.astype(np.float32)


def _views(count: int, *, with_pole: int | None = None) -> fusion.DepthViews:
  """Pictures from an arc of 80 degrees before the pole; the first so many show it."""
  poses = np.tile(np.eye(4), (count, 1, 1))
  for pose, angle in zip(poses, np.radians(np.linspace(-40, 40, count)), strict=True):
    eye = np.array([POLE[0] + 1.6 * np.sin(angle), POLE[1] - 1.6 * np.cos(angle), 0.9])
    ahead = np.array([*POLE, 0.6]) - eye
    pose[:3, :3], pose[:3, 3] = camera_axes(ahead / np.linalg.norm(ahead)), eye
  shown = count if with_pole is None else with_pole
  depth = np.stack([_depth(pose, pole=n < shown) for n, pose in enumerate(poses)])
  return fusion.DepthViews(camera=CAMERA, frame_from_camera=poses, depth=depth)


def _grid(views: fusion.DepthViews) -> fusion.Grid:
  return fusion.fuse(views, lower=LOWER, upper=UPPER, voxel=0.03, truncation=0.08)


def _heights(grid: fusion.Grid, solid: np.ndarray) -> np.ndarray:
  """Heights [m] between the floor's and the pole's end where a voxel at the pole is solid."""
  layers = [grid.centres(axis) for axis in range(3)]
  near = np.hypot(*np.meshgrid(layers[0] - POLE[0], layers[1] - POLE[1], indexing="ij")) < 0.04
  heights = layers[2][solid[near].any(0)]
  return heights[(heights > 0.1) & (heights < TOP - 0.05)]


def test_pixels_of_a_pole_are_thin_and_a_wide_box_is_not():
  views = _views(1)
  thinner = thin.thin_pixels(views.depth[0])
  behind = _depth(views.frame_from_camera[0], pole=False)
  pole = behind - views.depth[0] > fusion.EDGE * views.depth[0]
  assert pole.sum() > 100
  away = np.zeros_like(pole)
  away[3:-3, 3:-3] = True
  np.testing.assert_array_equal(thinner, pole & away)
  box = np.full((60, 80), 3.0, np.float32)
  box[20:40, 30:50] = 2.0
  assert not thin.thin_pixels(box).any()


def test_a_pole_is_matter_all_along_and_nothing_else_is():
  views = _views(15)
  grid = _grid(views)
  assert len(_heights(grid, grid.solid)) < 5  # what fused depth alone leaves of it
  found = thin.with_thin_things(grid, views)
  assert len(_heights(found, found.solid)) >= 0.95 * (TOP - 0.15) / 0.03
  new = np.argwhere(found.solid & ~grid.solid)
  away = np.hypot(*(grid.lower + grid.voxel * new)[:, :2].T - POLE[:, None])
  assert away.max() < RADIUS + grid.voxel


def test_it_stands_among_what_collides():
  views = _views(15)
  grid = collision.solid_grid(views, lower=LOWER, upper=UPPER, floor_threshold=0.04)
  heights = _heights(grid, grid.solid)
  assert heights.min() < 0.13
  assert heights.max() > TOP - 0.1


@pytest.mark.parametrize("shown", [2, 5])
def test_what_more_pictures_see_through_is_nothing(shown):
  views = _views(15, with_pole=shown)
  assert not len(thin.thin_voxels(views, _grid(views)))
