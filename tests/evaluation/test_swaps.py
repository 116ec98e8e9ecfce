"""One part of the gap at a time: true pictures, the robot's delay, a robot without secrets."""

import numpy as np
import pytest

from nerf2real import suite
from nerf2real.core.geometry.cameras import Camera
from nerf2real.evaluation.plants import plant as plants
from nerf2real.evaluation.plants import swaps
from nerf2real.evaluation.plants.rehearsed import RehearsedPlant
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.virtual.camera import Sensor, VirtualCamera
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.suite import loading
from nerf2real.suite.randomisation.draws import NOMINAL
from nerf2real.suite.scene import open_scene
from nerf2real.suite.sensors.camera import CameraSettings


def test_what_cannot_be_swapped_is_refused():
  for parts, plant, built_in, message in (
    (("physics",), "sim", True, "--swap physics with --plant sim: expected --plant virtual"),
    (("delay",), "both", True, "--swap delay with --plant both: expected --plant sim or --plant"),
    (("delay", "picture"), "robot", True, "--swap delay with --plant robot"),
    (("picture",), "sim", False, "of the built-in room alone"),
  ):
    with pytest.raises(ValueError, match=message):
      swaps.check(parts, plant=plant, built_in=built_in)
  for parts, plant in (
    ((), "robot"),
    (("picture", "delay"), "sim"),
    (("picture", "delay", "physics"), "virtual"),
  ):
    swaps.check(parts, plant=plant, built_in=True)
  swaps.check(("physics", "delay"), plant="virtual", built_in=False)


def test_cameras_take_each_others_parts():
  virtual, simulated = VirtualCamera(), CameraSettings(rate=15.0, gain=1.2, latency=0.01)
  late = swaps.camera_in_simulation(simulated, ("delay",))
  assert (late.gain, late.lens) == (1.2, None) and late.rate == virtual.rate == 30
  assert late.latency + 0.030 == pytest.approx(virtual.latency)
  seeing = swaps.camera_in_simulation(simulated, ("picture",))
  assert seeing.lens is None and seeing.white_balance == virtual.white_balance
  assert swaps.camera_in_simulation(simulated, ("lens",)).lens == virtual.lens
  assert (seeing.rate, seeing.latency) == (15.0, 0.01)
  late = swaps.camera_on_the_robot(virtual, simulated, ("delay", "physics"))
  assert (late.rate, late.latency) == (15.0, pytest.approx(0.04)) and late.noise == virtual.noise
  lens = swaps.camera_on_the_robot(virtual, simulated, ("lens",)).lens
  assert (lens.width, lens.height) == (320, 240) and lens.k1 == 0 and lens.cx == 160
  seeing = swaps.camera_on_the_robot(virtual, simulated, ("picture",))
  assert seeing.lens == virtual.lens
  assert (seeing.rate, seeing.latency) == (virtual.rate, virtual.latency)
  grey = np.full((2, 2, 3), 100, np.uint8)
  assert (Sensor(seeing).develop(grey) == grey).all()
  assert not (Sensor(virtual).develop(grey) == grey).all()


def test_a_robot_without_secrets_is_that_of_the_data_sheets():
  scene = open_scene(None)
  plain, known = (
    RehearsedPlant(
      scene, EvaluationSettings(robot_seed=(2,), swap=swap), image_size=None, world="floor"
    )
    for swap in ((), ("physics",))
  )
  sheet = Hidden.none()
  assert plain.plant_id == known.plant_id == "robot 2"
  assert plain.conditions == "" and known.conditions == "swapped physics"
  for plant, same in ((plain, False), (known, True)):
    found = plant.robot.body.hidden
    assert np.allclose(found.motors.strength, sheet.motors.strength) == same
    assert (found.payload == 0.0) == same
    plant.close()


def test_a_robot_sees_the_fields_pictures():
  """The swapped picture is the suite's own from the same pose, of the policy's size."""
  scene = open_scene(None)
  plant = RehearsedPlant(
    scene,
    EvaluationSettings(swap=("delay", "lens", "picture")),
    image_size=(30, 40),
    simulated=CameraSettings(rate=20.0),
    world="floor",
  )
  assert plant.conditions == "swapped delay and lens and picture"
  first = plant.start(plants.trials("navigation")[0][1])
  assert plant.robot.camera is not None and plant.robot.eyes is not None
  picture = plant.robot.eyes.picture()
  plant.close()
  assert first.observation["camera"].shape == picture.shape == (30, 40, 3)
  environment = suite.load("nerf_nav", randomisation=NOMINAL, random=0)
  environment.task.set_trial(plants.trials("navigation")[0][1])
  expected = environment.reset().observation["camera"]
  same, upside_down = (
    np.median(np.abs(picture - other.astype(float))) for other in (expected, expected[::-1])
  )
  assert same < 6 and upside_down > 3 * same


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
