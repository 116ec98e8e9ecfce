"""The world frame of an analytic room, seen through an arbitrary similarity."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry import cameras, similarity
from nerf2real.core.serialization import from_plain, to_plain
from nerf2real.scenes.alignment import markers, overrides, world_frame, yaw
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.settings import SceneSettings, with_marker
from tests.scenes import furnished_room

CAMERA = cameras.Camera.from_vertical_fov(0.9, 96, 72)


@pytest.fixture(scope="module")
def room():
  """A room in its own metric frame: sparse points, depth views and poses."""
  rng = np.random.default_rng(0)
  views = furnished_room.depth_views(furnished_room.walk(48), CAMERA, noise=0.003, rng=rng)
  points, _ = views.surface_points(stride=8)
  # The floor has little texture: most of its points are missing.
  points = points[(points[:, 2] > 0.05) | (rng.random(len(points)) < 0.15)]
  return views, points


def unit_frame(yaw_deg=33.0, tilt_deg=3.0, scale=0.4):
  """The similarity unit <- metres."""
  turn = Rotation.from_euler("z", yaw_deg, degrees=True)
  tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([0.6, 0.8, 0]))
  return similarity.Similarity(scale, (tilt * turn).as_matrix(), np.array([0.1, -0.2, -0.3]))


def solve(room, transform, *, marker=None, **kwargs):
  views, points = room
  moved = views.transformed(transform)
  surface, normals = moved.surface_points(stride=2)
  evidence = Evidence(transform.apply(points), moved.frame_from_camera, surface, normals, marker)
  return world_frame.align(evidence, **kwargs)


def marker(transform, spread=0.004):
  return markers.MarkerScale(
    1 / transform.scale, spread, "4X4_50", (1,), 9, 0.3, np.zeros((1, 4, 3))
  )


def tilt_deg(found, transform):
  """Angle between the world's z axis and the true up direction."""
  up = found.world_from_unit.rotation @ transform.rotation @ [0, 0, 1]
  return float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))


def test_marker_floor_walls_and_extent(room):
  transform = unit_frame()
  found = solve(room, transform, marker=marker(transform))
  total = (
    found.world_from_unit @ transform
  )  # world <- true metric frame: yaw multiple of 90 degrees
  assert found.scale_source == "marker" and not found.warnings
  assert total.scale == pytest.approx(1, rel=1e-9)
  assert tilt_deg(found, transform) < 0.15
  assert abs(total.translation[2]) < 0.01
  angle = np.degrees(np.arctan2(total.rotation[1, 0], total.rotation[0, 0]))
  assert abs((angle + 45) % 90 - 45) < 0.3
  assert found.yaw_source == "walls"
  size = found.extent_upper - found.extent_lower
  np.testing.assert_allclose(size[:2], [5.3, 4.3], atol=0.25)  # walls and margin, x the longer
  np.testing.assert_allclose((found.extent_upper + found.extent_lower)[:2], 0, atol=1e-9)
  assert found.extent_lower[2] == 0
  assert found.camera_height == pytest.approx(1.4, abs=0.08)


@pytest.mark.parametrize("yaw_deg", [33.0, -140.0])
def test_a_marker_gives_the_same_frame_in_every_film(room, yaw_deg):
  """Its centre at (0.7, -0.3) m and its upper edge at 20 degrees, in the room's own frame."""
  transform = unit_frame(yaw_deg=yaw_deg)
  local = 0.1 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
  turn = Rotation.from_euler("z", 20, degrees=True).as_matrix()
  corners = transform.apply(local @ turn.T + [0.7, -0.3, 0.0])[None]
  seen = marker(transform)._replace(corners=corners)

  told = solve(room, transform, marker=seen)
  total = told.world_from_unit @ transform
  assert told.yaw_source == "walls" and told.marker is not None
  np.testing.assert_allclose(told.marker[:2], total.apply([0.7, -0.3, 0.0])[:2], atol=1e-9)
  wanted = np.radians(20) + np.arctan2(total.rotation[1, 0], total.rotation[0, 0])
  assert np.cos(np.radians(told.marker.heading_deg) - wanted) == pytest.approx(1.0, abs=1e-6)

  place = MarkerPlace(1.7, 0.2, 20.0)  # so that the room is moved by (1, 0.5) m and not turned
  settings = world_frame.AlignSettings(marker_at=place)
  found = solve(room, transform, marker=seen, settings=settings)
  assert found.yaw_source == "marker"
  np.testing.assert_allclose(found.marker, place, atol=1e-9)
  total = found.world_from_unit @ transform
  np.testing.assert_allclose(total.apply([0.0, 0.0, 0.0])[:2], [1.0, 0.5], atol=2e-3)
  np.testing.assert_allclose(total.rotation, np.eye(3), atol=3e-3)
  middle = (found.extent_upper + found.extent_lower)[:2] / 2
  np.testing.assert_allclose(middle, [1.0, 0.5], atol=0.12)  # the room's own middle is its origin


def test_a_markers_place_needs_its_side():
  with pytest.raises(ValueError, match="--marker-side"):
    with_marker(SceneSettings(), MarkerPlace(0.0, 0.0, 0.0))
  settings = with_marker(SceneSettings(marker_side=0.2), MarkerPlace(1.0, 2.0, 30.0))
  assert settings.align.marker_at == (1.0, 2.0, 30.0)


@pytest.mark.parametrize("side", [4.0, 6.0])
@pytest.mark.parametrize("yaw_deg", [0, 45, 90, 180])
def test_axes_are_unique(side, yaw_deg):
  """Noise of a billionth and another order of the points turn neither square nor long rooms."""
  rng = np.random.default_rng(0)
  quarter = rng.uniform([-2, -2, 0], [2, 2, 2.5], (2000, 3))
  turns = [Rotation.from_euler("z", 90 * k, degrees=True).as_matrix() for k in range(4)]
  points = np.concatenate([quarter @ turn.T for turn in turns]) * [side / 4, 1, 1]
  points = points @ Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix().T
  normals = np.repeat(np.concatenate([turn[:1] for turn in turns]), 2000, axis=0)
  normals = normals @ Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix().T

  def axes(order, noise):
    evidence = Evidence(
      points[order], np.eye(4)[None], points[order] + noise, normals[order] + noise
    )
    in_room = np.ones(len(points), bool)
    nothing = overrides.Overrides()
    return yaw.choose_yaw(evidence, nothing, upright=np.eye(3), in_room=in_room)

  expected = axes(np.arange(len(points)), 0.0)
  assert expected.source == "walls"
  longer = np.abs(expected.value[0] @ [np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg)), 0])
  assert side == 4.0 or longer == pytest.approx(1.0, abs=1e-4)
  for _ in range(6):
    noise = 1e-9 * rng.standard_normal(points.shape)
    found = axes(rng.permutation(len(points)), noise)
    np.testing.assert_allclose(found.value, expected.value, atol=1e-6)


def test_sparse_points_alone_suffice(room):
  views, points = room
  transform = unit_frame(yaw_deg=-20)
  poses = transform.apply_pose(views.frame_from_camera)
  evidence = Evidence(transform.apply(points), poses, marker=marker(transform))
  found = world_frame.align(evidence)
  total = found.world_from_unit @ transform
  assert found.yaw_source == "points"
  assert tilt_deg(found, transform) < 0.5
  angle = np.degrees(np.arctan2(total.rotation[1, 0], total.rotation[0, 0]))
  assert abs((angle + 45) % 90 - 45) < 1.5


def test_a_foggy_field_does_not_lift_the_floor(room):
  """Depth that ends half way: the sparse points know better, and the warning says so."""
  views, points = room
  transform = unit_frame()
  fog = dataclasses.replace(views, depth=views.depth * np.float32(0.6)).transformed(transform)
  surface, normals = fog.surface_points(stride=2)
  evidence = Evidence(
    transform.apply(points), fog.frame_from_camera, surface, normals, marker(transform)
  )
  found = world_frame.align(evidence)
  assert "blurred" in found.warnings[0]
  assert abs((found.world_from_unit @ transform).translation[2]) < 0.03
  assert tilt_deg(found, transform) < 0.5


def test_unknown_scale_is_loud_and_a_known_height_is_used(room):
  transform = unit_frame()
  found = solve(room, transform)
  assert found.scale_source == "unknown" and "SCALE UNKNOWN" in found.warnings[0]
  assert found.camera_height == pytest.approx(1.4, rel=1e-6)
  height = np.median(room[0].positions[:, 2])
  found = solve(room, transform, settings=world_frame.AlignSettings(camera_height=float(height)))
  assert found.scale_source == "camera_height"
  assert found.world_from_unit.scale * transform.scale == pytest.approx(1, rel=0.01)
  doubtful = solve(room, transform, marker=marker(transform, spread=0.2))
  assert doubtful.scale_source == "unknown" and "uncertain" in doubtful.warnings[0]


def test_every_choice_can_be_overridden(room, tmp_path):
  transform = unit_frame()
  floor_points = transform.apply(np.array([[0, 0, 0.0], [2, 0, 0], [0, 1.5, 0], [1, 1, 0]]))
  two = transform.apply(np.array([[0.5, 0.5, 0.75], [1.9, 0.5, 0.75]]))
  path = tmp_path / "override.yaml"
  path.write_text(
    f"floor_points: {floor_points.tolist()}\nscale_points: {two.tolist()}\nscale_distance: 1.4\n"
    f"yaw_deg: 10\norigin: {transform.apply(np.array([0.5, 0.5, 0])).tolist()}\n"
    "extent_lower: [-1, -1, 0]\nextent_upper: [1, 1, 2]\nfloor_threshold: 0.07\n"
  )
  found = solve(room, transform, marker=marker(transform), override=overrides.read(path))
  total = found.world_from_unit @ transform
  assert (found.scale_source, found.floor_source, found.yaw_source) == (
    "points",
    "manual_points",
    "manual",
  )
  assert total.scale == pytest.approx(1, rel=1e-6)
  np.testing.assert_allclose(total.rotation[2], [0, 0, 1], atol=1e-6)
  np.testing.assert_allclose(total.apply(np.array([0.5, 0.5, 0.0])), 0, atol=1e-6)
  np.testing.assert_allclose(found.extent_upper, [1, 1, 2])
  assert found.floor_threshold == 0.07
  up = solve(
    room, transform, override=overrides.Overrides(up=transform.rotation @ [0, 0, 1.0], scale=2.5)
  )
  assert up.scale_source == "manual" and tilt_deg(up, transform) < 1e-4
  assert abs((up.world_from_unit @ transform).translation[2]) < 0.01


def test_alignment_of_the_shipped_bundle_is_read():
  values = Bundle.load().scene["alignment"]
  assert to_plain(from_plain(values, world_frame.Alignment)) == {"marker": None, **values}


def test_alignment_survives_json(room):
  found = solve(room, unit_frame())
  again = from_plain(json.loads(json.dumps(to_plain(found))), world_frame.Alignment)
  points = np.random.default_rng(0).random((5, 3))
  np.testing.assert_allclose(
    again.world_from_unit.apply(points), found.world_from_unit.apply(points)
  )
  assert again.warnings == found.warnings


@pytest.mark.parametrize(
  ("text", "message"),
  [
    ("scael: 2", 'unknown key "scael"'),
    ("scale: -1", "scale must be a positive number"),
    ("up: [0, 0]", "up must be a direction"),
    ("floor_points: [[0, 0, 0], [1, 1, 1], [2, 2, 2]]", "on one line"),
    ("scale_points: [[0, 0, 0], [1, 0, 0]]", "given together"),
    ("scale: 2\ncamera_height: 1", "both fix the scale"),
    ("extent_lower: [1, 0, 0]\nextent_upper: [0, 1, 1]", "must be below"),
    ("- 3", "expected keys"),
    ("scale: [", "no valid yaml"),
    ("# \xe9", "no valid yaml: 'utf-8' codec"),
  ],
)
def test_mistakes_in_the_override_file_are_one_line(tmp_path, text, message):
  path = tmp_path / "o.yaml"
  path.write_text(text, encoding="latin-1")
  with pytest.raises(ValueError, match=message) as error:
    overrides.read(path)
  assert "\n" not in str(error.value) and str(path) in str(error.value)
