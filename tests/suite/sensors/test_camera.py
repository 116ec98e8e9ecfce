"""The robot's camera: compositing, lens, response, against OpenCV and MuJoCo's GL."""

import dataclasses

import cv2
import mujoco
import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.suite.sensors import camera as camera_module
from nerf2real.suite.sensors.camera import CameraSettings, GeomCaster, RobotCamera
from tests.suite.synthetic import FlatRenderer

LENS = Camera(
  width=640,
  height=480,
  fx=620.0,
  fy=610.0,
  cx=330.0,
  cy=231.0,
  k1=0.11,
  k2=-0.21,
  p1=0.002,
  p2=-0.003,
)

MODEL = """
<mujoco>
  <worldbody>
    <geom name="wall" type="box" pos="3 0 0" size=".1 3 3" group="0"/>
    <body name="head" pos="0.2 -0.1 1.1" euler="3 -8 20">
      <freejoint/>
      <geom name="skull" type="box" size=".05 .05 .05" group="1"/>
      <camera name="eye" xyaxes="0 -1 0 0 0 1"/>
    </body>
    <body name="marker" pos="1.2 0.1 0.9"><freejoint/>
      <geom name="marker" type="sphere" size="0.008" rgba="0 1 0 1"/>
    </body>
    <body name="brick" pos="1.1 0.5 1.1" euler="20 30 40"><freejoint/>
      <geom name="brick" type="box" size=".1 .06 .03" rgba="1 0 0 1"/>
    </body>
    <body name="limb" pos="0.9 0.2 1.0" euler="50 20 0"><freejoint/>
      <geom name="limb" type="capsule" size=".03 .1" rgba="0 0 1 1"/>
    </body>
  </worldbody>
</mujoco>
"""
COLORS = {"marker": 1, "brick": 0, "limb": 2}  # the channel in which each geom shines


@pytest.fixture(scope="module")
def world():
  model = mujoco.MjModel.from_xml_string(MODEL)
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  return model, data


def _camera(model, renderer=None, *, lens=LENS, world_from_unit=None, **settings):
  camera = RobotCamera(
    renderer or FlatRenderer(color=(0, 0, 0)),
    lens,
    world_from_unit=world_from_unit or Similarity(),
    settings=CameraSettings(**settings),
  )
  camera.bind(model, model.camera("eye").id)
  return camera


def test_a_known_point_lands_where_opencv_says(world):
  model, data = world
  picture = _camera(model).render(data)
  rows, columns = np.nonzero(picture[..., COLORS["marker"]])
  found = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
  camera = model.camera("eye").id
  rotation = (data.cam_xmat[camera].reshape(3, 3) @ np.diag([1, -1, -1])).T
  translation = -rotation @ data.cam_xpos[camera]
  matrix = np.array([[620.0, 0, 330.0 - 0.5], [0, 610.0, 231.0 - 0.5], [0, 0, 1]])
  point = data.geom("marker").xpos[None]
  expected, _ = cv2.projectPoints(
    point, cv2.Rodrigues(rotation)[0], translation, matrix, np.array([0.11, -0.21, 0.002, -0.003])
  )
  # OpenCV counts from pixel centres, the camera from pixel corners.
  np.testing.assert_allclose(found, expected.ravel() + 0.5, atol=0.3)
  without, _ = cv2.projectPoints(point, cv2.Rodrigues(rotation)[0], translation, matrix, None)
  assert np.abs(without.ravel() + 0.5 - found).max() > 1.0  # the test can see the distortion


def test_depth_decides_what_is_seen(world):
  model, data = world
  unit = Similarity(2.5, np.eye(3), np.array([0.3, 0.1, -0.4]))
  pose = camera_module.world_from_camera(data, model.camera("eye").id)
  depth = {name: (np.linalg.inv(pose) @ np.append(data.geom(name).xpos, 1))[2] for name in COLORS}
  assert depth["limb"] < depth["brick"] - 0.15
  between = (depth["limb"] + depth["brick"]) / 2
  for meters, seen in ((5.0, {"marker", "brick", "limb"}), (between, {"limb"}), (0.2, set())):
    renderer = FlatRenderer(color=(0, 0, 0), depth=meters / unit.scale)
    picture = _camera(model, renderer, world_from_unit=unit).render(data)
    visible = {name for name, channel in COLORS.items() if picture[..., channel].any()}
    assert visible == seen, meters
    # The field is rendered from the same place, in its own frame.
    np.testing.assert_allclose(unit.apply(renderer.poses[-1][:3, 3]), pose[:3, 3], atol=1e-9)
    np.testing.assert_allclose(renderer.poses[-1][:3, :3], pose[:3, :3], atol=1e-9)
  renderer = FlatRenderer(color=(0, 0, 0), depth=0.1)
  overlay = _camera(model, renderer, compositing="overlay").render(data)
  assert all(overlay[..., channel].any() for channel in COLORS.values())


def test_static_and_head_geoms_are_not_drawn(world):
  model, data = world
  picture = _camera(model, FlatRenderer(color=(9, 9, 9))).render(data)
  # The wall is in view and the skull is around the camera: only the three moving geoms are drawn.
  names = {model.geom(i).name for i in set(_cast(model, data)[2])}
  assert names == set(COLORS)
  assert (picture == 9).all(axis=-1).mean() > 0.8


def _cast(model, data, lens=LENS):
  pose = camera_module.world_from_camera(data, model.camera("eye").id)
  return GeomCaster(model, lens).cast(data, pose)


def test_culling_changes_nothing(world):
  model, data = world
  pixels, depths, ids, _ = _cast(model, data)
  camera = model.camera("eye").id
  pose = camera_module.world_from_camera(data, camera)
  rays = LENS.rays().reshape(-1, 3) @ pose[:3, :3].T
  everything = np.array([1, 0, 0, 0, 0, 0], np.uint8)
  geom = np.zeros(1, np.int32)
  count = 0
  for index in range(0, len(rays), 7):
    distance = mujoco.mj_ray(model, data, pose[:3, 3], rays[index], everything, 0, -1, geom)
    where = np.flatnonzero(pixels == index)
    assert len(where) == (distance >= 0)
    if distance >= 0:
      count += 1
      assert ids[where[0]] == geom[0]
      assert depths[where[0]] == pytest.approx(distance)
  assert count > 500


def test_geoms_agree_with_mujocos_gl_picture(world):
  model, data = world
  lens = Camera.from_vertical_fov(np.deg2rad(45.0), 160, 120)  # MuJoCo's default field of view
  try:
    renderer = mujoco.Renderer(model, 120, 160)
  except Exception as error:
    pytest.skip(f"no GL on this machine: {error}")
  try:
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, camera="eye")
    segmentation = renderer.render()[..., 0]
  finally:
    renderer.close()
  ours = np.full(120 * 160, -1)
  pixels, _, ids, _ = _cast(model, data, lens)
  ours[pixels] = ids
  moving = np.isin(segmentation, [model.geom(name).id for name in COLORS])
  theirs = np.where(moving, segmentation, -1).ravel()
  assert (theirs >= 0).sum() > 300
  # Only silhouettes may differ: MuJoCo draws capsules and spheres as polygons.
  assert (ours != theirs).mean() < 0.005


def test_response_to_gain_exposure_and_white_balance(world):
  model, data = world
  color = (100, 150, 40)

  def pixel(**settings):
    return _camera(model, FlatRenderer(color=color), **settings).render(data)[0, 0]

  np.testing.assert_array_equal(pixel(), color)
  # Twice the light is 2^(1/2.2) = 1.3704 times the display value.
  np.testing.assert_array_equal(pixel(gain=2.0), [137, 206, 55])
  np.testing.assert_array_equal(pixel(gain=0.5, exposure=4.0), [137, 206, 55])
  np.testing.assert_array_equal(pixel(white_balance=(1.0, 0.5, 1.0)), [100, 109, 40])
  np.testing.assert_array_equal(pixel(gain=20.0), [255, 255, 156])


def test_noise_has_the_deviation_that_is_set(world):
  model, data = world
  camera = _camera(model, FlatRenderer(color=(120, 120, 120)), noise=4.0)
  noisy = camera.render(data, np.random.RandomState(0))[:100].astype(float)
  assert noisy.std() == pytest.approx(4.0, rel=0.03)
  assert noisy.mean() == pytest.approx(120, abs=0.1)
  same = camera.render(data, np.random.RandomState(0))
  np.testing.assert_array_equal(camera.render(data, np.random.RandomState(0)), same)


@pytest.mark.parametrize(
  ("settings", "message"),
  [
    ({"compositing": "front"}, "expected 'depth' or 'overlay'"),
    ({"gain": 0.0}, "gain must be positive"),
    ({"gain": np.inf}, "gain must be positive"),
    ({"noise": -1.0}, "noise must be 0 or more"),
    ({"white_balance": (1.0, -1.0, 1.0)}, "white_balance must be three positive factors"),
    ({"white_balance": (1.0, 1.0)}, "white_balance must be three positive factors"),
  ],
)
def test_impossible_settings_are_refused(settings, message):
  with pytest.raises(ValueError, match=message):
    CameraSettings(**settings)


@pytest.mark.parametrize("size", [(0, 40), (30, -1), (30,), "30x40"])
def test_impossible_picture_sizes_are_refused(size):
  with pytest.raises(ValueError, match="image_size must be"):
    CameraSettings().camera(size)


def test_default_lens_is_the_robots():
  lens = CameraSettings().camera((30, 40))
  assert (lens.height, lens.width) == (30, 40)
  assert 2 * np.arctan(15 / lens.fy) == pytest.approx(np.deg2rad(43.3))
  assert CameraSettings(lens=LENS).camera((30, 40)).fx == pytest.approx(620 / 16)


def test_a_longer_lens_is_rendered_and_taken_back(world):
  """The picture is that of a camera which has this lens: no magnified picture of the other."""
  model, data = world
  camera, declared = _camera(model), _camera(model).render(data)
  camera.set_focal_scale(2.0)
  longer = dataclasses.replace(LENS, fx=2 * LENS.fx, fy=2 * LENS.fy)
  np.testing.assert_array_equal(camera.render(data), _camera(model, lens=longer).render(data))
  camera.set_focal_scale(1.0)
  np.testing.assert_array_equal(camera.render(data), declared)
