"""Exports opened with the programs that they are for: mujoco, trimesh, pxr."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.capture.posed.transforms import read_transforms
from nerf2real.scenes.export import exporting, gltf, heightfield, mjcf, nerfstudio, texture, usd
from nerf2real.scenes.geometry import collision, convex
from nerf2real.scenes.geometry.mesh import Mesh
from tests.scenes import furnished_room

EXTENT = (np.array([-2.5, -2.0, 0.0]), np.array([2.5, 2.0, 2.5]))
LENS = Camera(width=64, height=48, fx=50.0, fy=51.0, cx=30.0, cy=26.0, k1=0.05)
POSE = furnished_room.look_at([-1.5, -0.5, 1.0], [1.2, 1.0, 0.5])


def _box(center, half) -> convex.Part:
  corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
  part = convex.hull(np.add(center, np.multiply(corners, half)))
  assert part is not None
  return part


@pytest.fixture(scope="module")
def parts():
  return [_box(*furnished_room.FURNITURE[name]) for name in ("table", "shelf", "box")]


@pytest.fixture(scope="module")
def visual():
  """The room's floor as a mesh of 200 faces, coloured by position, baked from two views."""
  x, y = np.meshgrid(np.linspace(-2.4, 2.4, 11), np.linspace(-1.9, 1.9, 11))
  vertices = np.stack([x.ravel(), y.ravel(), np.zeros(121)], -1)
  corner = np.arange(110).reshape(10, 11)[:, :10].ravel()
  faces = np.concatenate(
    [
      np.stack([corner, corner + 1, corner + 11], -1),
      np.stack([corner + 1, corner + 12, corner + 11], -1),
    ]
  )
  camera = Camera(width=160, height=120, fx=90.0, fy=90.0, cx=80.0, cy=60.0)
  poses = np.array(
    [
      furnished_room.look_at([s * 1.0, s * 0.9, 1.9], [s * 1.1 - s * 0.4, s * 0.5, 0.0])
      for s in (-1.0, 1.0)
    ]
  )
  views = furnished_room.depth_views(poses, camera)
  points = poses[:, None, None, :3, 3] + np.einsum(
    "nij,nhwj->nhwi", poses[:, :3, :3], camera.rays() * views.depth[..., None]
  )
  views = dataclasses.replace(views, color=_color_of(points))
  return texture.bake(Mesh(vertices, faces), views, texel=0.05)


def _color_of(points: np.ndarray) -> np.ndarray:
  """A smooth colour of the place."""
  scaled = points / [2.5, 2.0, 2.5]
  return np.clip(128 + 80 * scaled, 0, 255).astype(np.uint8)


def test_a_baked_texture_shows_each_place_its_colour(visual):
  """Reads the texture as a renderer does, at points inside the faces."""
  weights = np.random.default_rng(0).dirichlet([2, 2, 2], len(visual.faces))
  points = np.einsum("fk,fki->fi", weights, visual.vertices[visual.faces])
  place = np.einsum("fk,fki->fi", weights, visual.uv)
  size = len(visual.texture)
  column, row = (place[:, 0] * size).astype(int), ((1 - place[:, 1]) * size).astype(int)
  seen = visual.texture[row, column].astype(int)
  known = (seen != 128).any(-1)  # grey where a table hides the floor or no view looks
  assert known.mean() > 0.4
  assert np.percentile(np.abs(seen - _color_of(points))[known], 95) <= 6


def test_mujoco_opens_the_mjcf_and_its_camera_is_the_calibrated_one(parts, visual, tmp_path):
  spec = mjcf.scene_spec(parts, extent=EXTENT, name="room")
  mjcf.add_camera(spec, LENS, POSE, name="capture")
  mjcf.write(tmp_path / "room", spec, parts, visual)
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "room" / "scene.xml"))
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  assert model.ntex == 1 and model.mesh_texcoordnum[model.mesh("visual").id] == 3 * len(
    visual.faces
  )
  geom = np.zeros(1, np.int32)
  for x, y, top in ((1.2, 1.0, 0.75), (-0.9, -1.2, 0.4), (0.0, 0.0, 0.0)):
    collides = np.array([0, 0, 0, 1, 0, 0], np.uint8)
    reach = mujoco.mj_ray(model, data, [x, y, 2.0], [0, 0, -1.0], collides, 1, -1, geom)
    assert 2.0 - reach == pytest.approx(top, abs=1e-4)
  camera = model.camera("capture")
  np.testing.assert_allclose(data.cam("capture").xpos, POSE[:3, 3], atol=1e-6)
  axes = data.cam("capture").xmat.reshape(3, 3) @ OPENGL_FROM_OPENCV
  np.testing.assert_allclose(axes, POSE[:3, :3], atol=1e-5)  # MJCF is written to six digits
  focal, offset = np.split(model.cam_intrinsic[camera.id], 2)
  pixel = model.cam_sensorsize[camera.id] / model.cam_resolution[camera.id]
  np.testing.assert_allclose(focal / pixel, [LENS.fx, LENS.fy], rtol=1e-5)
  # MuJoCo counts the principal point from its image to the centre (seen in rendered pictures)
  centre = model.cam_resolution[camera.id] / 2 - offset / pixel
  np.testing.assert_allclose(centre, [LENS.cx, LENS.cy], rtol=1e-5)


def test_pictures_of_an_upright_camera_fit_into_the_offscreen_buffer(parts):
  spec = mjcf.scene_spec(parts, extent=EXTENT, name="room")
  mjcf.add_camera(spec, Camera.from_vertical_fov(1.0, 720, 1280), POSE, name="capture")
  seen = spec.compile().vis.global_
  assert (seen.offwidth, seen.offheight) == (1280, 1280)


def test_a_robot_in_the_mjcf_keeps_standing(parts, tmp_path):
  from nerf2real.suite.op3 import constants
  from nerf2real.suite.standalone import standing_robot

  spec = mjcf.scene_spec(parts, extent=EXTENT, name="room")
  mjcf.add_robot(spec, standing_robot(), np.array([0.0, 0.3, 1.0]))
  mjcf.write(tmp_path / "room", spec, parts, None)
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "room" / "scene.xml"))
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
  while data.time < 1.0:
    mujoco.mj_step(model, data)
  torso = data.body(f"op3/{constants.TORSO_LINK}")
  assert torso.xpos[2] == pytest.approx(0.246, abs=0.01)
  np.testing.assert_allclose(torso.xpos[:2], [0.0, 0.3], atol=0.03)
  assert np.arctan2(torso.xmat[3], torso.xmat[0]) == pytest.approx(1.0, abs=0.1)


def test_mujoco_opens_the_height_map(parts, tmp_path):
  height = heightfield.heights(parts, EXTENT, resolution=0.1)
  heightfield.write(tmp_path / "map", height, EXTENT, name="room")
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "map" / "scene.xml"))
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  geom = np.zeros(1, np.int32)
  # a box, the floor, a shelf in one corner; under the table top, which starts above 0.6 m, is free
  for x, y, top in ((-0.9, -1.2, 0.4), (0.0, 0.0, 0.0), (-2.3, 0.6, 1.8), (1.2, 1.0, 0.0)):
    reach = mujoco.mj_ray(model, data, [x, y, 4.0], [0, 0, -1.0], None, 1, -1, geom)
    assert 4.0 - reach == pytest.approx(top, abs=0.01)


def test_trimesh_opens_the_glb_in_metres_with_y_up(visual, tmp_path):
  gltf.write(tmp_path / "room.glb", visual)
  shown = trimesh.load_mesh(tmp_path / "room.glb", process=False)
  np.testing.assert_allclose(np.ptp(shown.vertices, axis=0), [4.8, 0.0, 3.8], atol=1e-5)
  picture = np.asarray(shown.visual.material.baseColorTexture.convert("RGB"))
  np.testing.assert_array_equal(picture, visual.texture)
  uv = shown.visual.uv[shown.faces]  # glTF counts v from the top; trimesh turns it back
  np.testing.assert_allclose(uv, visual.uv, atol=1e-5)


def test_pxr_opens_the_usd(parts, tmp_path):
  pytest.importorskip("pxr", reason="usd-core is not installed")
  from pxr import Usd, UsdGeom, UsdPhysics

  box = trimesh.creation.box((2.0, 1.0, 0.5))
  box.visual.vertex_colors = np.tile([255, 0, 51, 255], (8, 1))
  far = EXTENT[0] + [20, 0, 0], EXTENT[1] + [20, 0, 0]
  usd.write(
    tmp_path / "room.usdc",
    visual=box,
    parts=parts,
    extent=far,
    camera=LENS,
    world_from_camera=POSE,
  )
  stage = Usd.Stage.Open(str(tmp_path / "room.usdc"))
  assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
  shown = UsdGeom.Mesh(stage.GetPrimAtPath("/World/visual"))
  np.testing.assert_allclose(np.array(shown.GetPointsAttr().Get()), box.vertices, atol=1e-6)
  colors = np.array(shown.GetDisplayColorPrimvar().Get())
  np.testing.assert_allclose(colors[0], [1.0, 0.0, 0.2], atol=1e-6)
  colliders = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.MeshCollisionAPI)]
  assert len(colliders) == len(parts)
  hull = UsdGeom.Mesh(colliders[0])
  np.testing.assert_allclose(np.array(hull.GetPointsAttr().Get()), parts[0].vertices, atol=1e-6)
  floor = UsdGeom.Plane(stage.GetPrimAtPath("/World/floor"))
  assert (floor.GetWidthAttr().Get(), floor.GetLengthAttr().Get()) == (7.0, 6.0)
  assert tuple(floor.GetLocalTransformation().ExtractTranslation()) == (20.0, 0.0, 0.0)
  eye = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(Usd.TimeCode.Default())
  np.testing.assert_allclose(eye.transform.ExtractTranslation(), POSE[:3, 3], atol=1e-6)
  # a point of the room falls on the pixel where the calibrated pinhole has it
  point = np.array([0.5, 0.5, 0.4])
  seen = eye.frustum.ComputeViewMatrix() * eye.frustum.ComputeProjectionMatrix()
  x, y, _ = seen.Transform(tuple(point))
  local = POSE[:3, :3].T @ (point - POSE[:3, 3])
  pinhole = dataclasses.replace(LENS, k1=0.0, fy=LENS.fx)
  np.testing.assert_allclose([32 * (1 + x), 24 * (1 - y)], pinhole.project(local), atol=0.02)


def test_nerfstudios_transforms_come_back_as_they_were(tmp_path):
  poses = furnished_room.walk(4)
  names = [f"images/{k}.jpg" for k in range(4)]
  (tmp_path / "images").mkdir()
  for name in names:
    (tmp_path / name).touch()
  content = nerfstudio.transforms(LENS, poses, names)
  (tmp_path / "transforms.json").write_text(json.dumps(content))
  found = read_transforms(tmp_path)
  assert found.camera == LENS
  np.testing.assert_allclose(found.world_from_camera, poses, atol=1e-12)


def test_a_wrong_suffix_is_one_line(tmp_path):
  order = exporting.Order(None, tmp_path / "room.obj")
  with pytest.raises(ValueError, match=r"expected \.glb"):
    exporting.export("glb", order)
  with pytest.raises(ValueError, match="becomes a folder"):
    exporting.export("mjcf", order)


def test_where_nothing_can_be_written_is_refused_before_the_work(tmp_path):
  order = exporting.Order(Bundle(tmp_path, {}), tmp_path / f"{'x' * 300}.glb")
  with pytest.raises(OSError, match="too long"):
    exporting.export("glb", order)


@pytest.mark.parametrize("kind", ["mjcf", "nerfstudio", "heightfield"])
def test_a_folder_that_is_no_earlier_export_stays(kind, tmp_path):
  room = tmp_path / "out" / "room"
  (room / "collision").mkdir(parents=True)
  (room / "scene.json").write_text("{}")
  (tmp_path / "begun" / ".stages").mkdir(parents=True)
  (tmp_path / "model").mkdir()
  (tmp_path / "model" / "scene.xml").write_text("<mujoco/>")
  (tmp_path / "plain").write_text("")
  bundle = Bundle(room, {})
  for taken in (room, room.parent, room / "collision", tmp_path / "model", tmp_path / "begun"):
    (taken / "mine").write_text("")
    with pytest.raises(ValueError, match="^--out .*name .*\\.$"):
      exporting.export(kind, exporting.Order(bundle, taken))
    assert (taken / "mine").is_file()
  with pytest.raises(ValueError, match="is a file"):
    exporting.export(kind, exporting.Order(bundle, tmp_path / "plain"))


def test_the_folder_that_one_is_in_is_not_replaced(tmp_path, monkeypatch):
  (tmp_path / "out").mkdir()
  monkeypatch.chdir(tmp_path / "out")
  for out in (Path("."), tmp_path / "out"):
    with pytest.raises(ValueError, match="the folder that you are in"):
      exporting.export("mjcf", exporting.Order(Bundle(tmp_path / "room", {}), out))


def test_an_earlier_export_is_replaced(parts, tmp_path):
  out = tmp_path / "heights"
  room = tmp_path / "room"
  collision.write_parts(parts, room / "collision")
  extent = {name: corner.tolist() for name, corner in zip(("lower", "upper"), EXTENT, strict=True)}
  bundle = Bundle(room, {"extent": extent})
  for _ in range(2):
    exporting.export("heightfield", exporting.Order(bundle, out))
    assert (out / "scene.xml").is_file()


def test_a_file_of_the_bundle_or_a_folder_is_not_replaced_by_a_file(tmp_path):
  bundle = Bundle(tmp_path / "room", {})
  bundle.folder.mkdir()
  (tmp_path / "folder.glb").mkdir()
  with pytest.raises(ValueError, match="is a part of a scene bundle"):
    exporting.export("glb", exporting.Order(bundle, bundle.visual_path))
  with pytest.raises(ValueError, match="is a folder"):
    exporting.export("glb", exporting.Order(bundle, tmp_path / "folder.glb"))
