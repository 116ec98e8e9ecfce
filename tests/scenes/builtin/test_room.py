"""Tests of the built-in room: its truth, its pictures and its film."""

import json
import subprocess
import sys
from pathlib import Path

import av
import cv2
import mujoco
import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import yaw_matrix
from nerf2real.scenes.builtin import camera_path, filming, furniture, mujoco_renderer, room, solids
from nerf2real.scenes.builtin.placing import ROOM_SIZE


@pytest.fixture(scope="module")
def model():
  return room._compiled(0)


@pytest.fixture(scope="module")
def renderer():
  try:
    with room.room_eye(0) as opened:
      yield opened
  except mujoco_renderer.EglMissingError as error:
    pytest.skip(str(error))


def _looking(position, target) -> np.ndarray:
  position = np.asarray(position, float)
  forward = np.asarray(target, float) - position
  forward /= np.linalg.norm(forward)
  right = np.cross(forward, [0, 0, 1.0])
  right /= np.linalg.norm(right)
  pose = np.eye(4)
  pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
  pose[:3, 3] = position
  return pose


@pytest.mark.parametrize(
  "position, heading",
  [
    ((0.1, -1.0, 1.4), (0.1, 0.1, 0)),
    ((-0.5, 0.6, 0.5), (0.3, 0.2, 0.1)),
    ((1.4, 0.4, 1.0), (0, 0, 0)),
  ],
)
def test_marker_lands_where_the_truth_projects_it(renderer, position, heading):
  corners = furniture.marker_corners()
  pose = _looking(position, corners.mean(0) + heading)
  lens = filming.LENS
  picture, _ = room.true_view(lens, pose, eye=renderer)
  parameters = cv2.aruco.DetectorParameters()
  parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
  parameters.cornerRefinementWinSize = 3
  dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
  detector = cv2.aruco.ArucoDetector(dictionary, parameters)
  found, identities, _ = detector.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
  assert identities.ravel().tolist() == [furniture.MARKER_ID]
  camera_from_world = np.linalg.inv(pose)
  seen = corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
  # OpenCV counts from the centre of the first pixel, the lens from its corner
  expected, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
  assert np.abs(found[0][0] + 0.5 - expected[:, 0]).max() < 1.0


def test_depth_ends_on_the_true_surfaces(renderer):
  camera = filming.LENS.resized(80, 60)
  pose = _looking((-0.8, -1.0, 0.45), (1.0, 1.2, 0.3))
  _, depth = room.true_view(camera, pose, eye=renderer)
  points = (camera.rays() * depth[..., None]).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
  error = np.abs(room.builtin().distance(points))
  assert np.percentile(error, 95) < 0.005
  assert np.median(error) < 0.002


def test_small_pictures_are_area_means_of_large_ones(renderer):
  pose = _looking((0.8, -1.2, 0.44), (-1.0, 0.5, 0.2))
  small = Camera.from_vertical_fov(np.deg2rad(43.3), 40, 30)
  low, _ = room.true_view(small, pose, eye=renderer)
  high, _ = room.true_view(small.resized(640, 480), pose, eye=renderer)
  mean = high.reshape(30, 16, 40, 16, 3).mean((1, 3))
  assert np.abs(low - mean).mean() < 1.0


def test_room_is_the_same_for_a_seed_and_another_for_another():
  def placed(seed):
    things = furniture.furnish(np.random.default_rng([seed, 1]))
    return np.array([[*s.position, *s.size] for s in things if s.name.startswith("shelf")][:40])

  np.testing.assert_array_equal(placed(0), placed(0))
  assert not np.array_equal(placed(0), placed(1))


def test_open_floor_is_free(model):
  (x0, y0), (x1, y1) = furniture.FREE_AREA
  assert x1 - x0 >= 3 and y1 - y0 >= 3
  x, y, z = np.meshgrid(
    np.linspace(x0, x1, 40), np.linspace(y0, y1, 40), [0.03, 0.2, 0.4, 0.5], indexing="ij"
  )
  distance = room.builtin().distance(np.stack([x, y, z], -1).reshape(-1, 3))
  assert distance.min() >= 0.0


def test_path_keeps_clear_of_everything():
  path = camera_path.Walk(0, seconds=30.0).pose(np.linspace(0, 30, 300))
  np.testing.assert_allclose(
    path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1), [np.eye(3)] * 300, atol=1e-9
  )
  assert room.builtin().distance(path[:, :3, 3]).min() > 0.1
  assert path[:, 2, 3].min() < 0.5 and path[:, 2, 3].max() > 1.45


@pytest.mark.parametrize(
  "kind, size, rounding, mujoco_kind",
  [
    ("box", (0.3, 0.2, 0.1), 0.0, mujoco.mjtGeom.mjGEOM_BOX),
    ("cone", (0.2, 0.2, 0.3), 0.0, mujoco.mjtGeom.mjGEOM_CYLINDER),
    ("ellipsoid", (0.3, 0.1, 0.02), 0.0, mujoco.mjtGeom.mjGEOM_ELLIPSOID),
  ],
)
def test_distances_agree_with_mujoco(kind, size, rounding, mujoco_kind):
  rotation = yaw_matrix(0.7)
  solid = solids.Solid(
    name="s",
    kind=kind,
    size=size,
    position=np.array([0.1, 0.2, 0.3]),
    rotation=rotation,
    rounding=rounding,
    material="",
  )
  spec = mujoco.MjSpec()
  quaternion = np.empty(4)
  mujoco.mju_mat2Quat(quaternion, rotation.ravel())
  geom_size = [size[0], size[2], 0] if kind == "cone" else list(size)
  spec.worldbody.add_geom(type=mujoco_kind, size=geom_size, pos=[0.1, 0.2, 0.3], quat=quaternion)
  probe = spec.worldbody.add_body(name="probe", mocap=True)
  probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-6, 0, 0])
  compiled = spec.compile()
  data = mujoco.MjData(compiled)
  points = np.random.default_rng(0).uniform(-0.8, 0.8, (60, 3)) + solid.position
  expected = []
  for point in points:
    data.mocap_pos[0] = point
    mujoco.mj_kinematics(compiled, data)
    expected.append(mujoco.mj_geomDistance(compiled, data, 0, 1, 10.0, None))
  found = solid.signed_distance(points)
  outside = found > 1e-3
  assert outside.sum() > 20
  np.testing.assert_allclose(found[outside], np.array(expected)[outside], atol=2e-4)


@pytest.mark.parametrize(
  "kind, size, rounding",
  [
    ("box", (0.3, 0.2, 0.1), 0.05),
    ("cone", (0.1, 0.25, 0.3), 0.0),
    ("ellipsoid", (0.3, 0.2, 0.1), 0.0),
  ],
)
def test_meshes_lie_on_the_zero_of_the_distance(kind, size, rounding):
  solid = solids.Solid(
    name="s", kind=kind, size=size, position=np.zeros(3), rounding=rounding, material=""
  )
  mesh = solids.tessellate(solid)
  np.testing.assert_allclose(solid.signed_distance(mesh.vertices), 0, atol=1e-6)
  np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-9)
  corners = mesh.vertices[mesh.faces]
  across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
  outwards = (across * mesh.normals[mesh.faces].mean(1)).sum(-1)
  assert (outwards[np.linalg.norm(across, axis=-1) > 1e-7] > 0).all()


def test_surface_samples_border_free_space():
  points, normals = room.builtin().surface(400)
  assert points.shape == normals.shape == (400, 3)
  distance = room.builtin().distance(points)
  assert np.abs(distance).max() < 0.01  # chords of the curved meshes
  assert room.builtin().distance(points + 0.02 * normals).min() > 0.01
  floor = np.abs(points[:, 2]) < 1e-3
  assert 0.1 < floor.mean() < 0.5


def test_things_can_be_put_into_the_room_and_rest_on_its_floor():
  spec = room.build_room(0)
  ball = spec.worldbody.add_body(name="ball", pos=[0.3, -0.8, 0.12])
  ball.add_freejoint()
  ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=0.2)
  compiled = spec.compile()
  data = mujoco.MjData(compiled)
  for _ in range(300):
    mujoco.mj_step(compiled, data)
  np.testing.assert_allclose(data.body("ball").xpos, [0.3, -0.8, 0.1], atol=0.004)


def test_film_is_whole_and_its_truth_fits(renderer, tmp_path):
  settings = filming.FilmSettings(
    camera=filming.LENS.resized(160, 120), seconds=4.0, frame_rate=2.0, subframes=1, supersample=1
  )
  steps = []
  video = tmp_path / "room.mp4"
  filming.film(video, settings=settings, progress=lambda *report: steps.append(report))
  assert sorted(p.name for p in tmp_path.iterdir()) == ["room.mp4", "room_truth.json"]
  with av.open(str(video)) as container:
    frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
  assert len(frames) == settings.frames == 8 == len(steps)
  assert steps[-1] == (1.0, "picture 8 of 8")
  truth = filming.read_truth(tmp_path / "room_truth.json")
  assert truth["camera"] == settings.camera
  assert truth["world_from_camera"].shape == (8, 4, 4)
  picture, _ = room.true_view(truth["camera"], truth["world_from_camera"][5], eye=renderer)
  assert np.mean((picture - frames[5].astype(float)) ** 2) < 10**-2.2 * 255**2  # 22 dB
  np.testing.assert_allclose(truth["marker"]["corners"], furniture.marker_corners())


def test_truth_of_another_version_is_refused(tmp_path):
  path = tmp_path / "truth.json"
  path.write_text(json.dumps({"version": 99}))
  with pytest.raises(ValueError, match=r"version 99, expected 1"):
    filming.read_truth(path)


def test_interrupted_film_leaves_nothing(renderer, tmp_path):
  def stop(fraction, text):
    raise KeyboardInterrupt

  settings = filming.FilmSettings(
    camera=filming.LENS.resized(64, 48), seconds=1.0, frame_rate=4.0, subframes=1, supersample=1
  )
  with pytest.raises(KeyboardInterrupt):
    filming.film(tmp_path / "room.mp4", settings=settings, progress=stop)
  assert list(tmp_path.iterdir()) == []


def test_missing_egl_names_the_packages(monkeypatch, model):
  def missing():
    raise ImportError("no EGL here")

  monkeypatch.setattr(mujoco_renderer, "_context_class", missing)
  with pytest.raises(mujoco_renderer.EglMissingError, match="libegl1 libegl-mesa0 libgl1-mesa-dri"):
    mujoco_renderer.Eye(model)


def test_shipped_film_and_truth_belong_together():
  folder = filming.SHIPPED_VIDEO.parent
  truth = filming.read_truth(folder / "room_truth.json")
  with av.open(str(filming.SHIPPED_VIDEO)) as container:
    frame = next(container.decode(video=0))
    count = container.streams.video[0].frames
  assert count == len(truth["world_from_camera"])
  assert (frame.width, frame.height) == (truth["camera"].width, truth["camera"].height)
  assert truth["room_size"] == list(ROOM_SIZE)
  np.testing.assert_allclose(truth["marker"]["corners"], furniture.marker_corners())


def test_making_a_scene_loads_no_robot(tmp_path):
  """The room and the script that makes scenes need nothing above scenes."""
  root = Path(__file__).parents[3]
  program = """
import runpy, sys
script = runpy.run_path(sys.argv[1], run_name="loaded")
try:
  script["run"](script["Arguments"](capture="missing.mp4", out=script["Path"]("unused")))
except ValueError as error:
  assert "missing.mp4" in str(error)
print(*(name for name in sys.modules if name.startswith("nerf2real.")))
"""
  script = root / "launch" / "make_scene.py"
  result = subprocess.run(
    [sys.executable, "-c", program, script],
    cwd=tmp_path,
    capture_output=True,
    text=True,
    check=True,
  )
  packages = {name.split(".")[1] for name in result.stdout.split()}
  assert packages == {"core", "scenes", "launch"}
  assert "nerf2real.scenes.builtin.ground_truth" in result.stdout.split()
