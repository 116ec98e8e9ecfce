"""One part of the gap at a time: true pictures, the robot's delay, a robot without secrets."""

import numpy as np
import pytest

from nerf2real.core.cameras import Camera
from nerf2real.evaluation.plants import swaps
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual.camera import VirtualCamera
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.suite import loading
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import CameraSettings


def test_what_cannot_be_swapped_is_refused():
  for swap, plant, built_in, message in (
    ("picture", "virtual", True, "--swap picture with --plant virtual: expected --plant sim"),
    ("physics", "sim", True, "--swap physics with --plant sim"),
    ("delay", "both", True, "--swap delay with --plant both"),
    ("picture", "sim", False, "of the built-in room alone"),
  ):
    with pytest.raises(ValueError, match=message):
      swaps.check(swap, plant=plant, built_in=built_in)
  for swap, plant in (("none", "robot"), ("picture", "sim"), ("delay", "sim")):
    swaps.check(swap, plant=plant, built_in=True)
  swaps.check("physics", plant="virtual", built_in=False)


def test_the_simulated_camera_takes_the_robots_timing():
  camera = swaps.camera_of_the_robot(CameraSettings(rate=15.0, gain=1.2))
  assert camera.gain == 1.2
  assert camera.rate == VirtualCamera().rate == 30
  assert camera.latency + 0.030 == pytest.approx(VirtualCamera().latency)


def test_a_robot_without_secrets_is_that_of_the_data_sheets():
  scene = open_scene(None)
  plain, known = (
    RehearsedPlant(
      scene, EvaluationSettings(robot_seed=(2,), swap=swap), image_size=None, world="floor"
    )
    for swap in ("none", "physics")
  )
  sheet = Hidden.none()
  assert plain.plant_id == "robot 2" and known.plant_id == "robot 2, data sheet's physics"
  for plant, same in ((plain, False), (known, True)):
    found = plant.robot.body.hidden
    assert np.allclose(found.motors.strength, sheet.motors.strength) == same
    assert (found.payload == 0.0) == same
    plant.close()


@pytest.mark.slow
def test_the_true_room_is_seen_from_the_fields_frame():
  """The picture resembles the field's from the same pose, and its depth is in the field's unit."""
  scene = open_scene(None)
  camera = Camera.from_vertical_fov(np.deg2rad(43.3), 40, 30)
  pose = np.eye(4)
  pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looking along world's x
  pose[:3, 3] = (*np.mean(np.asarray(scene.extent), axis=0)[:2], 0.45)
  unit = scene.world_from_unit.inverse().apply_pose(pose)
  true = swaps.TrueRoom(scene)
  seen, depth = true.render(camera, unit)
  true.close()
  field, field_depth = loading.load_renderer(scene).render(camera, unit)
  assert seen.shape == field.shape == (30, 40, 3)
  assert np.median(np.abs(seen.astype(float) - field)) < 12
  known = np.isfinite(field_depth)
  assert np.median(np.abs(depth[known] / field_depth[known] - 1)) < 0.1
