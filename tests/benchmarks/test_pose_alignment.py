"""A picture that was taken elsewhere than localised is aligned to the field's, or by its points."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rooms import pose_alignment
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.tracks import Tracks
from tests.scenes.synthetic_model import NO_TRACKS

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0, k1=0.05)
FREQUENCIES = np.array([[9.0, 4.0], [-5.0, 11.0], [13.0, -7.0]])


def _picture(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Colour [H, W, 3] and depth [H, W] of a waved pattern on the slanted plane z = 2 + x / 2."""
  ways = CAMERA.rays() @ pose[:3, :3].T
  normal = np.array([-0.5, 0.0, 1.0])
  depth = (2 - normal @ pose[:3, 3]) / (ways @ normal)
  place = (pose[:3, 3] + depth[..., None] * ways)[..., :2]
  return np.rint(128 + 80 * np.sin(place @ FREQUENCIES.T)).astype(np.uint8), depth


def _localisation(tracks: Tracks, points: np.ndarray) -> Localisation:
  return Localisation(
    camera=CAMERA,
    names=("a.jpg",),
    world_from_camera=np.eye(4)[None],
    points=points,
    point_colors=np.zeros((len(points), 3), np.uint8),
    point_errors=np.ones(len(points)),
    reprojection_error_px=1.0,
    registered_fraction=1.0,
    strategy="",
    unit_from_source=Similarity(1.0, np.eye(3), np.zeros(3)),
    tracks=tracks,
  )


def _true_pose() -> np.ndarray:
  """A pose that moves the picture by about a pixel."""
  pose = np.eye(4)
  pose[:3, :3] = Rotation.from_rotvec([0.004, -0.006, 0.005]).as_matrix()
  pose[:3, 3] = [0.006, -0.004, 0.01]
  return pose


def test_a_pose_is_found_by_the_field_s_colours():
  color, depth = _picture(np.eye(4))
  image, _ = _picture(_true_pose())
  alone = _localisation(NO_TRACKS, np.zeros((0, 3)))
  found = pose_alignment.align(alone, 0, image, color, depth)
  assert found.moved_px > 0.5
  assert found.color[1] < 0.1 * found.color[0]
  turn = Rotation.from_matrix(found.pose[:3, :3].T @ _true_pose()[:3, :3]).magnitude()
  assert turn < 0.0005  # a thirteenth of a pixel
  assert np.linalg.norm(found.pose[:3, 3] - _true_pose()[:3, 3]) < 0.002


def test_points_hold_the_pose_of_a_plain_picture():
  _, depth = _picture(np.eye(4))
  plain = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
  rng = np.random.default_rng(0)
  rays = CAMERA.rays(rng.uniform([5, 5], [155, 115], (60, 2)))
  points = rays * rng.uniform(1.0, 3.0, (len(rays), 1))
  pose = _true_pose()
  tracks = Tracks(
    np.zeros(len(points), np.int64),
    np.arange(len(points)),
    CAMERA.project((points - pose[:3, 3]) @ pose[:3, :3]),
  )
  found = pose_alignment.align(_localisation(tracks, points), 0, plain, plain, depth)
  assert found.reprojection[0] > 0.5
  assert found.reprojection[1] < 0.02
  assert np.linalg.norm(found.pose[:3, 3] - pose[:3, 3]) < 0.001
