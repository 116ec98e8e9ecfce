"""Depth that stands above a floor which the pictures show: moved down; all else stays."""

import dataclasses

import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.geometry.corrections import seen_floor
from tests.scenes import furnished_room

LOWER, UPPER = np.array([-2.6, -2.1, 0.0]), np.array([2.6, 2.1, 1.5])
BUMP, PLAIN, RADIUS, HEIGHT = np.array([0.2, -0.7]), np.array([1.3, -1.2]), 0.3, 0.12


def _texture(points):
  """Grey levels [...] of points [..., 3]: waves of 10 to 25 cm; none around PLAIN."""
  phases = points @ np.array([[61, 17, -23], [-29, 53, 31], [25, 25, -40.0]]).T
  contrast = np.where(np.linalg.norm(points[..., :2] - PLAIN, axis=-1) < 2 * RADIUS, 0.0, 25.0)
  return 120 + contrast * np.sin(phases).sum(-1)


@pytest.fixture(scope="module")
def film():
  """Views with true depth, their pictures, and the heights and floor places of their pixels."""
  camera = cameras.Camera.from_vertical_fov(0.9, 160, 120)
  poses = [
    furnished_room.look_at(
      [0.3 + 1.1 * np.cos(a), -0.2 + 0.9 * np.sin(a), 1.4], [0.2, -0.9 + 0.2 * np.sin(3 * a), 0.0]
    )
    for a in np.linspace(0.0, 2.5, 36)
  ]
  views = furnished_room.depth_views(np.array(poses), camera)
  ways = np.einsum("nij,hwj->nhwi", views.frame_from_camera[:, :3, :3], camera.rays())
  points = views.positions[:, None, None] + views.depth[..., None] * ways
  noise = np.random.default_rng(0).normal(0, 2, views.depth.shape)
  return views, _texture(points) + noise, points, ways


def _raised(views, points, ways, place):
  """The views with the floor around a place [2] raised, and the pixels that show it."""
  there = (np.linalg.norm(points[..., :2] - place, axis=-1) < RADIUS) & (points[..., 2] < 1e-3)
  higher = (HEIGHT - views.positions[:, None, None, 2]) / ways[..., 2]
  return dataclasses.replace(
    views, depth=np.where(there, higher, views.depth).astype(np.float32)
  ), there


def _corrected(views, pictures, chosen=None):
  chosen = range(len(views.depth)) if chosen is None else chosen
  return seen_floor.with_seen_floor(views, pictures, chosen, lower=LOWER, upper=UPPER).depth


def test_textured_floor_is_found_behind_a_bump(film):
  views, pictures, points, ways = film
  bumped, there = _raised(views, points, ways, BUMP)
  found = _corrected(bumped, pictures)
  height = (views.positions[:, None, None] + found[..., None] * ways)[..., 2]
  assert there.sum() > 2000
  assert (np.abs(height[there]) < 1e-3).mean() > 0.9


def test_furniture_stays_where_it_is(film):
  views, pictures, points, _ = film
  found = _corrected(views, pictures)
  matter = points[..., 2] > 0.03
  assert (np.abs(found - views.depth)[matter] > 1e-3).mean() < 0.002


def test_a_floor_without_texture_is_no_evidence(film):
  views, pictures, points, ways = film
  bumped, there = _raised(views, points, ways, PLAIN)
  found = _corrected(bumped, pictures)
  assert there.sum() > 500
  assert (found[there] == bumped.depth[there]).mean() > 0.95


def test_pictures_that_are_not_chosen_take_no_part(film):
  views, pictures, points, ways = film
  bumped, _ = _raised(views, points, ways, BUMP)
  chosen = np.arange(0, len(pictures), 2)
  spoilt = pictures.copy()
  spoilt[1::2] = np.random.default_rng(1).uniform(0, 255, spoilt[1::2].shape)
  assert np.array_equal(_corrected(bumped, pictures, chosen), _corrected(bumped, spoilt, chosen))
