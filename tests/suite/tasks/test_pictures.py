"""The picture in the two tasks: what is in it, and when it was taken."""

import mujoco
import numpy as np
import pytest

from nerf2real import suite
from nerf2real.suite.effects import Effect
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL
from nerf2real.suite.sensors.camera import CameraSettings, world_from_camera
from tests.suite.synthetic import FlatRenderer


def test_own_arm_appears_in_the_picture(nav):
  nav.reset()
  physics, camera = nav.physics, nav.task.robot_camera
  assert (camera.render(physics.data.ptr) == (40, 80, 120)).all()
  physics.named.data.qpos[["op3/l_sho_pitch", "op3/l_sho_roll", "op3/l_el"]] = -1.6, 1.0, -1.2
  mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
  pixels, _, ids, _ = camera.caster.cast(
    physics.data.ptr, world_from_camera(physics.data.ptr, camera.camera_id)
  )
  assert len(pixels) > 10
  assert {physics.model.ptr.geom(int(i)).name.split("/")[1][:4] for i in ids} <= {"l_el", "l_sh"}
  assert (camera.render(physics.data.ptr).reshape(-1, 3)[pixels] != (40, 80, 120)).any()


def test_the_ball_appears_in_the_picture_unless_the_room_is_before_it(ball):
  renderer = ball.task.robot_camera._renderer
  ball.task.set_start(Pose(-1.0, 0.0, 0.0), ball_xy=(0.0, 0.0))
  orange = {}
  for depth in (np.inf, 0.3 / ball.task.scene.world_from_unit.scale):
    renderer.depth = depth
    picture = ball.reset().observation["camera"].astype(int)
    orange[depth] = np.argwhere((picture[..., 0] > 90) & (picture[..., 2] < 40))
  renderer.depth = np.inf
  visible, hidden = orange.values()
  assert len(visible) > 30 and len(hidden) == 0
  # A metre ahead a ball of 24 cm spans atan(0.24 / 1) of 43.3 degrees in 30 rows: about 9 rows.
  assert np.ptp(visible[:, 0]) + 1 == pytest.approx(9, abs=2)
  assert visible[:, 1].mean() == pytest.approx(19.5, abs=3)  # straight ahead


def test_picture_is_late_by_the_camera_latency(room):
  poses = {}
  for latency in (0.0, 0.05):
    renderer = FlatRenderer()
    environment = suite.load(
      "nerf_nav",
      scene=room,
      renderer=renderer,
      random=0,
      randomisation=NOMINAL,
      camera=CameraSettings(latency=latency),
    )
    environment.task.set_start(Pose(0.0, 0.0, 0.0))
    environment.reset()
    for _ in range(8):
      environment.step(np.where(np.arange(20) == 0, 1.0, environment.task.standing_action))
    poses[latency] = renderer.poses
  for step in range(3, 9):  # 50 ms are two control steps
    np.testing.assert_array_equal(poses[0.05][step], poses[0.0][step - 2])
  assert not np.array_equal(poses[0.0][8], poses[0.0][6])


def test_an_undeclared_lens_is_the_cameras_own_and_magnifies_nothing(room, nav):
  effects = [Effect("camera_focal", None, {"scale": 1.5})]
  environment = suite.load(
    "nerf_nav",
    scene=room,
    renderer=FlatRenderer(),
    random=0,
    randomisation=NOMINAL,
    camera=CameraSettings(latency=0.0),
    effects=effects,
  )
  seen = environment.reset().observation["camera"]
  camera = environment.task.robot_camera
  assert camera.camera.fx == pytest.approx(1.5 * nav.task.robot_camera.camera.fx)
  np.testing.assert_array_equal(seen, camera.render(environment.physics.data.ptr))


@pytest.mark.parametrize("rate", [10.0, 15.0, 30.0, 40.0])
def test_a_slower_camera_holds_its_last_picture(room, rate):
  """In 3 s there are 3 s times `rate` pictures, evenly spread; the robot's motion is the same."""
  rendered, joints = {}, {}
  for each in (40.0, rate):
    renderer = FlatRenderer()
    environment = suite.load(
      "nerf_nav",
      scene=room,
      renderer=renderer,
      random=3,
      randomisation=NOMINAL,
      camera=CameraSettings(rate=each),
    )
    environment.task.set_start(Pose(0.0, 0.0, 0.0))
    environment.reset()
    steps = [len(renderer.poses)]
    for _ in range(120):
      timestep = environment.step(environment.task.standing_action)
      steps.append(len(renderer.poses))
    rendered[each], joints[each] = np.array(steps), timestep.observation["joint_positions"]
  np.testing.assert_array_equal(joints[rate], joints[40.0])
  assert rendered[rate][0] == 1  # there is a picture from the start on
  assert abs(rendered[rate][-1] - 1 - 3.0 * rate) <= 1
  gaps = np.diff(np.flatnonzero(np.diff(rendered[rate])))
  assert np.floor(40 / rate) <= gaps.min() and gaps.max() <= np.ceil(40 / rate)
