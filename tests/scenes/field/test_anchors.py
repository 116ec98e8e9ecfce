"""Localised points: distances along pixels' rays, and the space that they show to be empty."""

import dataclasses

import numpy as np
import pycolmap

from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.field import anchors
from nerf2real.scenes.poses import localisation
from tests.scenes import box_views


def _model(views, points, *, scale=2):
  """A COLMAP model whose pictures are `scale` times as large and see all points before them."""
  camera = views.camera.resized(scale * views.camera.width, scale * views.camera.height)
  model = pycolmap.Reconstruction()
  params = [camera.fx, camera.fy, camera.cx, camera.cy, camera.k1, camera.k2, camera.p1, camera.p2]
  model.add_camera_with_trivial_rig(
    pycolmap.Camera(
      camera_id=1, model="OPENCV", width=camera.width, height=camera.height, params=params
    )
  )
  places = []
  for k, pose in enumerate(views.world_from_camera):
    inverse = np.linalg.inv(pose)
    image = pycolmap.Image(name=views.names[k], camera_id=1, image_id=k + 1)
    pixels = camera.project((points @ inverse[:3, :3].T) + inverse[:3, 3])
    ahead = ((points @ inverse[:3, :3].T) + inverse[:3, 3])[:, 2] > 0.1
    inside = ahead & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels[inside]])
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse[:3]))
    places.append(np.flatnonzero(inside))
  for index, point in enumerate(points):
    track = pycolmap.Track()
    for k, seen in enumerate(places):
      if index in seen:
        track.add_element(k + 1, int(np.flatnonzero(seen == index)[0]))
    if track.length() >= 2:
      identity = model.add_point3D(point, track, np.zeros(3, np.uint8))
      model.points3D[identity].error = 0.5
  return model


def _known_points(model, views):
  figures = {
    "reprojection_error_px": 0.5,
    "registered_fraction": 1.0,
    "strategy": "made",
    "unit_from_source": Similarity(),
  }
  return anchors.known_points(localisation.from_model(model, figures), views.camera)


def test_known_points_lie_on_their_pixels_rays():
  views = box_views.make_views(30, width=64, height=48)
  points = np.random.default_rng(1).uniform(-0.7, 0.7, (80, 3))
  model = _model(views, points)
  known = _known_points(model, views)
  assert len(known) > 40
  nearest = []
  for picture, x, y, distance in known:
    origin, directions = box_views.rays(views, int(picture))
    place = origin + distance * directions[int(y), int(x)]
    nearest.append(np.linalg.norm(points - place, axis=-1).min() / distance)
  # A pixel's middle is at most 0.71 pixels from the point that lies in it.
  assert max(nearest) < 0.75 * views.camera.pixel_angle


def test_points_of_two_views_or_with_large_errors_are_left_out():
  views = box_views.make_views(30, width=64, height=48)
  model = _model(views, np.random.default_rng(1).uniform(-0.7, 0.7, (80, 3)))
  few = {i for i, point in model.points3D.items() if point.track.length() == 2}
  bad = next(i for i in model.points3D if i not in few)
  before = _known_points(model, views)
  seen = model.points3D[bad].track.length()
  model.points3D[bad].error = 5.0
  after = _known_points(model, views)
  assert few
  total = sum(p.track.length() for p in model.points3D.values() if p.track.length() > 2)
  assert len(before) == total
  assert len(before) - len(after) == seen


def test_empty_cells_lie_inside_the_walls():
  views = box_views.make_views(8, width=64, height=48, anchors=300)
  cells = anchors.empty_cells(views)
  size = anchors.EMPTY_CELLS
  centres = (np.stack(np.unravel_index(cells, (size,) * 3), -1) + 0.5) * 2 / size - 1
  assert len(cells) > 1000
  assert np.abs(centres).max() < box_views.HALF_SIZE
  for eye in views.world_from_camera[:, :3, 3]:  # every camera stands in empty space
    assert np.linalg.norm(centres - eye, axis=-1).min() < 2 / size


def test_what_stands_near_one_camera_is_not_empty():
  """Three points beside a camera, which another one sees: of all points they are few."""
  views = box_views.make_views(8, width=64, height=48, anchors=300)
  poses = views.world_from_camera.copy()
  eye, other = poses[0, :3, 3], poses[1, :3, 3]
  place = eye + np.array([0.0, 0.0, 0.12])
  distance = np.linalg.norm(place - other)
  poses[1, :3, :3] = camera_axes((place - other) / distance)
  seen = np.tile(np.float32([1, 32, 24, distance]), (3, 1))
  known = np.concatenate([views.anchors[views.anchors[:, 0] != 1], seen])
  changed = dataclasses.replace(views, world_from_camera=poses, anchors=known)
  size = anchors.EMPTY_CELLS
  cells = anchors.empty_cells(changed)
  centres = (np.stack(np.unravel_index(cells, (size,) * 3), -1) + 0.5) * 2 / size - 1
  assert np.linalg.norm(centres - place, axis=-1).min() > 0.05
  assert np.linalg.norm(centres - eye, axis=-1).min() < 2 / size


def test_without_points_nothing_is_known():
  assert len(anchors.empty_cells(box_views.make_views(3))) == 0
