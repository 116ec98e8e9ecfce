"""Scale from a rendered marker; poses and sizes are known."""

import cv2
import numpy as np
import pytest

from nerf2real.core.geometry import cameras
from nerf2real.scenes.alignment import markers
from tests.scenes import furnished_room

CAMERA = cameras.Camera(
  width=960, height=540, fx=800, fy=805, cx=483, cy=268, k1=-0.08, k2=0.02, p1=0.001, p2=-0.0005
)
SIDE = 0.16  # m
UNIT = 0.4  # units of the model per metre
U, V = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
# Four rays a pixel against aliasing.
RAYS = [CAMERA.rays(np.stack([U + a, V + b], -1)) for a in (0.25, 0.75) for b in (0.25, 0.75)]


def picture(pose, dictionary, identifier, rng):
  """Renders a marker that lies on the floor at the origin, by casting every pixel's ray."""
  bits = cv2.aruco.generateImageMarker(
    cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")), identifier, 512
  )
  board = np.full((768, 768), 255, np.uint8)  # a white margin of half a marker
  board[128:640, 128:640] = bits
  total = np.zeros((CAMERA.height, CAMERA.width), np.float32)
  for local in RAYS:
    rays = local @ pose[:3, :3].T
    t = -pose[2, 3] / np.where(rays[..., 2] < -1e-6, rays[..., 2], -1e-6)
    hit = pose[:3, 3] + t[..., None] * rays
    column = ((hit[..., 0] / SIDE + 0.5) * 512 + 128 - 0.5).astype(np.float32)
    row = ((0.5 - hit[..., 1] / SIDE) * 512 + 128 - 0.5).astype(np.float32)
    total += cv2.remap(board, column, row, cv2.INTER_LINEAR, borderValue=128).astype(np.float32) / 4
  return np.clip(total + 2 * rng.standard_normal(total.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
  rng = np.random.default_rng(0)
  angles = np.linspace(0.3, 2.2, 8)
  positions = np.c_[0.9 * np.cos(angles), 0.9 * np.sin(angles), rng.uniform(0.5, 0.9, 8)]
  poses = np.array([furnished_room.look_at(p, [0.05, 0.02, 0]) for p in positions])
  return poses, [picture(p, "APRILTAG_36h11", 7, rng) for p in poses]


def in_units(poses):
  poses = poses.copy()
  poses[:, :3, 3] *= UNIT
  return poses


def test_scale_within_half_a_percent(scene):
  poses, pictures = scene
  found = markers.detect(pictures)
  scale = markers.marker_scale(found, camera=CAMERA, frame_from_camera=in_units(poses), side=SIDE)
  assert scale.dictionary == "APRILTAG_36h11" and scale.markers == (7,)
  assert scale.detections == len(pictures)
  assert scale.metres_per_unit == pytest.approx(1 / UNIT, rel=0.005)
  assert scale.spread < 0.01 and scale.error_px < 0.5
  corners = scale.corners[0] / UNIT
  np.testing.assert_allclose(
    corners, SIDE / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]), atol=2e-3
  )


def test_wrong_poses_and_misread_codes_are_dropped(scene):
  poses, pictures = scene
  found = markers.detect(pictures, dictionaries=[["APRILTAG_36h11"]])
  bad = in_units(poses)
  bad[2, :3, 3] += 0.05  # one localised pose is off by 12 cm
  misread = markers.Detection(
    "4X4_1000", 3, 1, np.array([[10.0, 10], [90, 10], [90, 90], [10, 90]])
  )
  scale = markers.marker_scale([*found, misread], camera=CAMERA, frame_from_camera=bad, side=SIDE)
  assert scale.detections == len(pictures) - 1
  assert scale.metres_per_unit == pytest.approx(1 / UNIT, rel=0.005)


def test_without_a_marker_a_bounded_number_of_pictures_is_searched(monkeypatch):
  """All codes in every picture had taken minutes where no marker is in sight."""
  reads, read = [], markers._read
  monkeypatch.setattr(markers, "_read", lambda image: reads.append(1) or read(image))
  blank = np.full((90, 160), 128, np.uint8)
  for count, looks in ((5, 5), (150, 60), (1000, 60)):
    reads.clear()
    assert markers.detect([blank] * count) == [] and len(reads) == looks


@pytest.mark.parametrize("first", [0, 70, 101, 147])
def test_a_marker_in_three_pictures_in_a_row_is_found(scene, first):
  _, pictures = scene
  shown = [np.full((90, 160), 128, np.uint8)] * 150
  shown[first : first + 3] = pictures[:3]
  found = markers.detect(shown)
  assert {(d.dictionary, d.marker) for d in found} == {("APRILTAG_36h11", 7)}
  assert [d.view for d in found] == [first, first + 1, first + 2]


def test_nothing_found_is_none_and_mistakes_are_named(scene):
  poses, pictures = scene
  found = markers.detect(pictures[:2])
  assert markers.marker_scale(found, camera=CAMERA, frame_from_camera=poses, side=SIDE) is None
  with pytest.raises(ValueError, match="positive"):
    markers.marker_scale(found, camera=CAMERA, frame_from_camera=poses, side=0)
  with pytest.raises(ValueError, match="Unknown marker dictionary"):
    markers.detect(pictures[:1], dictionaries=[["9X9"]])
