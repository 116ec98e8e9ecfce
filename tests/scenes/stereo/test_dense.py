"""Dense stereo in a room whose distances are known; half of one wall is plain."""

import dataclasses

import numpy as np
import pytest

from nerf2real.core.geometry.cameras import PIXEL_CENTRE, Camera
from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.stereo.dense import (
  NeighbourSettings,
  StereoSettings,
  dense_points,
  neighbours,
)
from tests.scenes import box_views

CAMERA = Camera(width=160, height=120, fx=140, fy=140, cx=80, cy=60, k1=0.05)
SETTINGS = StereoSettings(width=160, points=10**6)


def _colour(points: np.ndarray) -> np.ndarray:
  """Grey [...] of points on the walls [..., 3]: many waves, none where y > 0 on the far wall."""
  waves = np.random.default_rng(3).normal(0, 25, (24, 3))
  grey = 0.5 + 0.1 * np.sin(points @ waves.T + np.arange(24)).sum(-1)
  plain = (points[..., 0] > box_views.HALF_SIZE - 1e-6) & (points[..., 1] > 0)
  return np.where(plain, 0.5, np.clip(grey, 0, 1))


def _distances(pose: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Distances [...] along the rays of pixels [..., 2] and the points there [..., 3]."""
  rays = CAMERA.rays(pixels) @ pose[:3, :3].T
  rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
  distance = box_views.wall_distance(pose[:3, 3], rays)
  return distance, pose[:3, 3] + distance[..., None] * rays


@pytest.fixture(scope="module")
def views() -> Views:
  rng = np.random.default_rng(0)
  images, poses, known = [], [], []
  for n, y in enumerate(np.linspace(-0.3, 0.3, 7)):
    pose = np.eye(4)
    pose[:3, 3] = [-0.4, y, rng.uniform(-0.1, 0.1)]
    ahead = np.array([0.8, 0.1 * y, -0.1]) - pose[:3, 3]
    pose[:3, :3] = camera_axes(ahead / np.linalg.norm(ahead))
    grey = _colour(_distances(pose, CAMERA.pixel_centres())[1])
    images.append(np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, -1))
    poses.append(pose)
    pixels = np.column_stack([rng.integers(0, 160, 60), rng.integers(0, 120, 60)])
    distance = _distances(pose, pixels + PIXEL_CENTRE)[0]
    known.append(np.column_stack([np.full(60, n), pixels, distance]))
  names = tuple(f"{n}.png" for n in range(len(images)))
  anchors = np.concatenate(known).astype(np.float32)
  return Views(CAMERA, np.stack(images), np.stack(poses), names, anchors=anchors)


@pytest.fixture(scope="module")
def points(views) -> np.ndarray:
  return dense_points(views, SETTINGS)


def test_points_are_where_the_walls_are(views, points):
  errors = []
  for n in range(len(views)):
    mine = points[points[:, 0] == n]
    true = _distances(views.world_from_camera[n], mine[:, 1:3] + PIXEL_CENTRE)[0]
    errors.append(mine[:, 3] / true - 1)
  error = np.abs(np.concatenate(errors))
  assert len(points) > 0.4 * len(views) * 80 * 60  # a fifth of the pixels see the plain wall
  assert np.median(error) < 0.003
  assert np.mean(error < 0.015) > 0.97


def test_a_plain_wall_has_no_points_but_beside_what_shows(views, points):
  inside = 0
  for n, pose in enumerate(views.world_from_camera):
    mine = points[points[:, 0] == n]
    hit = _distances(pose, mine[:, 1:3] + PIXEL_CENTRE)[1]
    far = (hit[:, 0] > box_views.HALF_SIZE - 1e-6) & (np.abs(hit[:, 2]) < 0.65)
    inside += (far & (hit[:, 1] > 0.12) & (hit[:, 1] < 0.68)).sum()
  assert inside < 0.01 * len(points)


def test_of_a_picture_some_points_are_taken(views):
  few = dense_points(views, dataclasses.replace(SETTINGS, points=50))
  assert np.bincount(few[:, 0].astype(int)).tolist() == 7 * [50]


def test_neighbours_see_the_same_from_beside(views):
  settings = NeighbourSettings(most=3, least_angle=0.15)
  found = neighbours(views, settings)
  eyes = views.world_from_camera[:, :3, 3]
  for n, others in enumerate(found):
    assert 0 < len(others) <= 3
    assert n not in others
    assert np.linalg.norm(eyes[others] - eyes[n], axis=-1).min() > 0.15  # the wall is 1.2 away
  turned = views.world_from_camera.copy()
  turned[0, :3, [0, 2]] *= -1  # looks the other way
  away = neighbours(dataclasses.replace(views, world_from_camera=turned), settings)
  assert all(0 not in others for others in away[1:])
