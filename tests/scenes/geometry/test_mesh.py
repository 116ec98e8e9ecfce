"""Fusion, marching cubes and their cleaning against an analytic room."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from nerf2real.core.geometry import cameras, similarity
from nerf2real.scenes import bundle
from nerf2real.scenes.geometry import fusion, mesh
from tests.scenes import furnished_room

CAMERA = cameras.Camera(width=112, height=84, fx=87, fy=87.5, cx=56.5, cy=41.2, k1=0.06, k2=-0.05)
LOWER, UPPER, VOXEL = np.array([-2.7, -2.2, -0.15]), np.array([2.7, 2.2, 2.7]), 0.04


@pytest.fixture(scope="module")
def views():
  return furnished_room.depth_views(
    furnished_room.walk(48), CAMERA, noise=0.004, rng=np.random.default_rng(0)
  )


@pytest.fixture(scope="module")
def grid(views):
  return fusion.fuse(views, lower=LOWER, upper=UPPER, voxel=VOXEL, truncation=0.1)


def centres(grid):
  return np.stack(np.meshgrid(*[grid.centres(a) for a in range(3)], indexing="ij"), -1)


def test_lifted_depth_lies_on_the_room(views):
  points, normals = views.surface_points(stride=4)
  assert np.percentile(furnished_room.distance(points), 95) < 0.02
  floor = points[:, 2] < 0.02
  assert floor.sum() > 500
  assert np.percentile(normals[floor, 2], 20) > 0.97


def test_fused_surface_lies_on_the_room(grid):
  found = mesh.drop_small_pieces(mesh.surface(grid), min_component=0.3)
  error = furnished_room.distance(found.vertices)
  assert np.median(error) < 0.008
  assert np.percentile(error, 90) < 0.04
  # Every face looks into the free space that it was seen from.
  a, b, c = (found.vertices[found.faces[:, i]] for i in range(3))
  front = (a + b + c) / 3 + 0.06 * np.cross(b - a, c - a) / np.linalg.norm(
    np.cross(b - a, c - a), axis=-1, keepdims=True
  ).clip(1e-12)
  index = np.round((front - grid.lower) / grid.voxel).astype(int)
  index = np.clip(index, 0, np.array(grid.values.shape) - 1)
  assert (grid.values[tuple(index.T)] > 0).mean() > 0.97


def test_free_space_is_free_and_hidden_space_unknown(grid):
  places = centres(grid)
  truth = furnished_room.distance(places.reshape(-1, 3)).reshape(grid.values.shape)
  walk = (np.abs(places[..., 0]) < 0.4) & (np.abs(places[..., 1]) < 0.7)
  walk &= (places[..., 2] > 0.3) & (places[..., 2] < 1.6) & (truth > 0.15)
  assert (grid.values[walk] > 0.5).mean() > 0.99
  inside = (np.abs(places - [-2.3, 0.6, 0.9]) < [0.02, 0.4, 0.6]).all(-1)  # the shelf's core
  assert not grid.observed[inside].any()


def test_units_do_not_matter(views, grid):
  """Fusing in another frame and unit gives the same distances at corresponding voxels."""
  half = similarity.Similarity(0.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
  again = fusion.fuse(
    views.transformed(half),
    lower=half.apply(LOWER),
    upper=half.apply(UPPER),
    voxel=0.5 * VOXEL,
    truncation=0.05,
  )
  both = again.observed & grid.observed
  assert both.sum() > 0.99 * grid.observed.sum()
  assert np.percentile(np.abs(again.values - grid.values)[both], 99) < 0.02


def test_floaters_are_dropped(grid):
  """A ball of matter in the air goes, the furniture stays."""
  places = centres(grid)
  ball = np.linalg.norm(places - [0.0, -0.4, 1.2], axis=-1) < 0.12
  values = np.where(ball, np.float32(-1), grid.values)
  dirty = grid._replace(values=values, weights=np.where(ball, np.float32(1), grid.weights))
  assert dirty.solid[ball].all()
  cleaned = mesh.drop_floaters(dirty, min_component=0.6)
  assert not cleaned.solid[ball].any()
  assert ndimage.label(cleaned.solid)[1] < ndimage.label(dirty.solid)[1]
  error = furnished_room.distance(mesh.surface(cleaned).vertices)
  assert (error > 0.15).sum() <= (furnished_room.distance(mesh.surface(grid).vertices) > 0.15).sum()


def test_paint_simplify_and_glb(views, grid, tmp_path):
  """Pictures whose colour is the world position give vertices that colour; glTF is y up."""
  rays = CAMERA.rays()
  colors = []
  for pose, depth in zip(views.frame_from_camera, views.depth, strict=True):
    world = pose[:3, 3] + depth[..., None] * (rays @ pose[:3, :3].T)
    colors.append(np.clip(128 + 40 * world, 0, 255).astype(np.uint8))
  painted_views = dataclasses.replace(views, color=np.stack(colors))
  small = mesh.simplify(mesh.surface(grid), faces=12_000)
  assert len(small.faces) <= 12_500
  painted = mesh.paint(small, painted_views)
  known = (painted.colors != 128).any(-1)
  assert known.mean() > 0.9
  error = np.abs(painted.colors - np.clip(128 + 40 * small.vertices, 0, 255))[known]
  assert np.median(error) < 2 and np.percentile(error, 95) < 8
  path = tmp_path / "visual.glb"
  mesh.save_glb(painted, path)
  loaded = trimesh.load(path, force="mesh", process=False)
  np.testing.assert_allclose(loaded.vertices[:, 1], small.vertices[:, 2], atol=1e-5)
  np.testing.assert_allclose(loaded.vertices[:, 2], -small.vertices[:, 1], atol=1e-5)
  assert b'"NORMAL"' in path.read_bytes()  # without them programs shade flat faces
  back = mesh.load_glb(path)
  np.testing.assert_allclose(back.vertices, small.vertices, atol=1e-5)
  np.testing.assert_array_equal(back.visual.vertex_colors[:, :3], painted.colors)
  with pytest.raises(ValueError, match="does not exist"):
    mesh.load_glb(tmp_path / "none.glb")


def test_the_visual_mesh_lies_within_the_bundles_extent():
  scene = bundle.Bundle.load()
  found = mesh.load_glb(scene.visual_path)
  lower, upper = scene.extent
  settings = scene.scene["settings"]["mesh"]
  voxel, below = settings["voxel"], np.array([0.0, 0.0, settings["truncation"]])
  assert (found.bounds[0] > lower - below - voxel).all() and (found.bounds[1] < upper + voxel).all()
  assert (np.ptp(found.bounds, axis=0) > 0.8 * (upper - lower)).all()


def test_nothing_seen_is_said(views):
  with pytest.raises(ValueError, match="no surface"):
    mesh.surface(fusion.fuse(views, lower=[40, 40, 0], upper=[41, 41, 1], voxel=0.1))
  with pytest.raises(ValueError, match="voxels"):
    fusion.fuse(views, lower=LOWER, upper=UPPER, voxel=0.002)
  with pytest.raises(ValueError, match="Depth pictures have shape"):
    fusion.DepthViews(
      camera=CAMERA, frame_from_camera=views.frame_from_camera, depth=views.depth[:3]
    )
