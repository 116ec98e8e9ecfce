"""The two tasks: life cycle, observations, endings, success, randomisation and bad input."""

import json

import mujoco
import numpy as np
import pytest
from absl.testing import absltest
from dm_control import composer
from dm_env import StepType, test_utils

from nerf2real import suite
from nerf2real.suite import protocols
from nerf2real.suite.effects import Effect
from nerf2real.suite.op3 import constants
from nerf2real.suite.randomisation.draws import RandomisationSettings
from nerf2real.suite.sensors.camera import CameraSettings, world_from_camera
from nerf2real.suite.tasks import ball_push, nerf_nav, rewards
from nerf2real.suite.tasks.state import Start
from tests.suite.synthetic import FlatRenderer, make_room

NOMINAL = RandomisationSettings(
  pushes=False,
  delays=False,
  jitter=False,
  torso_mass=False,
  imu_pose=False,
  ball_mass=False,
  ball_radius=False,
)
POLICY = {
  "gyroscope": (5, 3),
  "accelerometer": (5, 3),
  "gravity": (5, 3),
  "joint_positions": (5, 20),
  "previous_control": (5, 20),
  "goal": (2,),
  "camera": (30, 40, 3),
}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
  return make_room(tmp_path_factory.mktemp("room"))


def load(task, room, **options):
  return suite.load(task, scene=room, renderer=FlatRenderer(), **options)


@pytest.fixture(scope="module")
def nav(room):
  return load("nerf_nav", room, random=0, randomisation=NOMINAL)


@pytest.fixture(scope="module")
def ball(room):
  return load("ball_push", room, random=0, randomisation=NOMINAL)


@pytest.fixture(autouse=True)
def _free_start(request):
  yield
  for name in ("nav", "ball"):
    if name in request.fixturenames:
      request.getfixturevalue(name).task.set_start(None)


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_conforms_to_dm_env(task, room):
  class Conformance(test_utils.EnvironmentTestMixin, absltest.TestCase):
    def make_object_under_test(self):
      return load(task, room, random=3, time_limit=1.0)

    def make_action_sequence(self):
      rng = np.random.default_rng(0)
      for _ in range(60):
        yield rng.uniform(-1, 1, 20).astype(np.float32)

  result = absltest.unittest.TestResult()
  absltest.unittest.defaultTestLoader.loadTestsFromTestCase(Conformance).run(result)
  assert result.testsRun >= 4
  assert not result.failures and not result.errors, result.failures + result.errors


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_observations_are_those_of_the_design(task, room):
  environment = load(task, room, random=0)
  spec = environment.observation_spec()
  observation = environment.reset().observation
  assert {k: v.shape for k, v in observation.items() if not k.startswith("privileged/")} == POLICY
  assert observation["camera"].dtype == np.uint8
  for name in ("robot_position", "robot_velocity", "goal", "randomisation"):
    assert f"privileged/{name}" in spec
  assert ("privileged/ball_position" in spec) == (task == "ball_push")
  for name, value in observation.items():
    spec[name].validate(value)
    assert name == "camera" or value.dtype == np.float32
  bare = load(task, room, random=0, privileged=False)
  assert set(bare.observation_spec()) == set(POLICY)
  blind = load(task, room, random=0, image_size=None)
  assert "camera" not in blind.reset().observation


def _episode(environment, steps=25):
  rng = np.random.default_rng(1)
  steps = [environment.reset()] + [environment.step(rng.uniform(-1, 1, 20)) for _ in range(steps)]
  return steps


def _same(a, b):
  return all(
    x.reward == y.reward
    and x.step_type == y.step_type
    and all(np.array_equal(x.observation[k], y.observation[k]) for k in x.observation)
    for x, y in zip(a, b, strict=True)
  )


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_the_same_seed_gives_the_same_episode_bit_for_bit(task, room):
  settings = CameraSettings(noise=2.0)
  first, again = (load(task, room, random=7, camera=settings) for _ in range(2))
  for _ in range(2):  # the second episode too
    assert _same(_episode(first), _episode(again))
  other = load(task, room, random=8, camera=settings)
  assert not _same(_episode(load(task, room, random=7, camera=settings)), _episode(other))


def test_reset_does_not_recompile(room):
  environment = load("ball_push", room, random=0)
  model = environment.physics.model.ptr
  masses = set()
  for _ in range(5):
    environment.reset()
    assert environment.physics.model.ptr is model
    masses.add(float(model.body_mass.sum()))
  assert len(masses) == 5  # and yet every episode has other masses


def test_stands_under_zero_action_change_and_reaches_the_time_limit(nav):
  nav.task.set_start(Start((-1.0, 0.0), 0.4), goal_index=0)
  timestep = nav.reset()
  action = nav.task.standing_action
  count = 0
  while not timestep.last():
    timestep = nav.step(action)
    count += 1
  assert count == 1200  # 30 s at 40 Hz
  assert timestep.discount == 1.0 and nav.task.outcome.ending is None
  np.testing.assert_allclose(nav.task.state.position[:2], [-1.0, 0.0], atol=0.01)
  assert nav.task.state.yaw == pytest.approx(0.4, abs=0.02)
  gravity = timestep.observation["gravity"][-1]
  np.testing.assert_allclose(gravity, [0, 0, -1], atol=0.02)
  np.testing.assert_allclose(timestep.observation["accelerometer"][-1], [0, 0, 9.81], atol=0.1)
  np.testing.assert_allclose(
    timestep.observation["joint_positions"][-1], constants.standing_targets(), atol=0.04
  )


def test_action_filter_is_exponential(nav):
  nav.reset()
  start = nav.task.standing_action
  action = np.full(20, 0.5)
  one, two = nav.step(action), nav.step(action)
  control = two.observation["previous_control"]
  first = 0.8 * start + 0.2 * 0.5
  np.testing.assert_allclose(control[-2], first, atol=1e-6)
  np.testing.assert_allclose(control[-1], 0.8 * first + 0.2 * 0.5, atol=1e-6)
  np.testing.assert_array_equal(one.observation["previous_control"][-1], control[-2])
  lower, upper = constants.joint_limits()
  expected = (lower + upper) / 2 + control[-1] * (upper - lower) / 2
  np.testing.assert_allclose(nav.physics.data.ctrl, expected, atol=1e-6)


def test_head_pan_reaches_further_in_ball_pushing(nav, ball):
  for environment, limit in ((nav, 0.79), (ball, 2.5)):
    environment.reset()
    for _ in range(60):
      environment.step(np.where(np.arange(20) == 0, 1.0, environment.task.standing_action))
    pan = environment.physics.named.data.qpos["op3/head_pan"]
    assert float(pan[0]) == pytest.approx(limit, abs=0.03)


def _step_until_end(environment, action, limit=200):
  for _ in range(limit):
    timestep = environment.step(action)
    if timestep.last():
      return timestep
  raise AssertionError("the episode did not end")


@pytest.mark.parametrize("name", ["nav", "ball"])
def test_a_fall_ends_the_episode(name, request):
  environment = request.getfixturevalue(name)
  far = {"ball_xy": (0.0, 1.0)} if name == "ball" else {}
  environment.task.set_start(Start((-1.0, 0.0), 0.0), **far)
  environment.reset()
  environment.physics.data.ptr.qvel[4] = 8.0  # a somersault
  last = _step_until_end(environment, environment.task.standing_action)
  assert last.discount == 0.0 and environment.task.outcome.ending == "fall"
  assert environment.step(environment.task.standing_action).step_type == StepType.FIRST
  assert environment.task.outcome.ending is None


def test_touching_the_room_ends_navigation_unless_it_is_a_foot(nav):
  # The table's edge is at x = 2, 0.5 m high: the robot's chest against it, then its toes
  # against a sill of 3 cm.
  nav.task.set_start(Start((1.97, 1.8), 0.0))
  nav.reset()
  last = _step_until_end(nav, nav.task.standing_action, 3)
  assert last.discount == 0.0 and nav.task.outcome.ending == "collision"
  nav.task.set_start(Start((0.0, 0.0), 0.0))
  nav.reset()
  toes = float(nav.physics.named.data.geom_xpos["op3/l_ank_roll_link_0", "x"]) + 0.0635
  nav.task.set_start(Start((2.0 - toes + 0.002, 0.0), 0.0))
  nav.reset()
  nav.step(nav.task.standing_action)
  model, pairs = nav.physics.model.ptr, nav.physics.data.ptr.contact.geom
  touched = {
    model.body(int(model.geom_bodyid[g])).name
    for pair in pairs
    for g in pair
    if any(model.geom_group[other] == 3 for other in pair) and model.geom_group[g] != 3
  }
  assert touched and touched <= {"op3/l_ank_roll_link", "op3/r_ank_roll_link"}
  assert nav.task.outcome.ending is None


def test_navigation_succeeds_within_25_cm_and_rewards_it(nav):
  goal = nav.task.goals[1]
  for distance, success in ((0.27, False), (0.23, True)):
    nav.task.set_start(Start((goal[0] - distance, goal[1]), 0.0), goal_index=1)
    observation = nav.reset().observation
    np.testing.assert_allclose(observation["goal"], goal, atol=1e-6)
    np.testing.assert_allclose(observation["privileged/goal"], [distance, 0], atol=1e-3)
    nav.step(nav.task.standing_action)
    assert nav.task.outcome.success is success
    assert nav.task.reward_terms["navigate_sparse"] == float(success)
  assert nav.task.outcome.success_time == pytest.approx(0.025)


def test_reward_is_the_weighted_sum_of_the_logged_terms(nav, ball):
  for environment, weights in (
    (nav, {"turn": 1, "speed": 0.5, "pose": 0.5, "navigate_sparse": 1, "navigate": 0.25}),
    (ball, {"turn": 1, "speed": 0.5, "pose": 0.5, "ball": 1}),
  ):
    environment.reset()
    reward = environment.step(environment.task.standing_action).reward
    terms = dict(environment.task.reward_terms)
    assert reward == terms.pop("total")
    assert terms.keys() == weights.keys()
    assert reward == pytest.approx(sum(weights[k] * v for k, v in terms.items()))
    assert terms["pose"] < 0


def test_feet_velocity_is_that_of_the_whole_robot_sliding(nav):
  nav.task.set_start(Start((-1.0, 0.0), 1.1))
  nav.reset()
  data = nav.physics.data.ptr
  data.qvel[:2] = 0.3 * np.cos(1.1), 0.3 * np.sin(1.1)
  mujoco.mj_forward(nav.physics.model.ptr, data)
  state = nav.task._indices.read()
  np.testing.assert_allclose(state.feet_velocity, [0.3, 0, 0], atol=2e-3)
  assert rewards.speed(state.feet_velocity[0]) == pytest.approx(1.0, abs=0.01)


def test_start_poses_fill_the_free_space(room):
  environment = load("nerf_nav", room, random=0, image_size=None, privileged=False)
  places, goals = [], []
  for _ in range(300):
    environment.reset()
    state = environment.task.state
    places.append([*state.position[:2], state.yaw])
    goals.append(tuple(environment.task.goal))
  places = np.array(places)
  for axis, (low, high) in enumerate(((-2.6, 1.6), (-2.1, 2.1), (-np.pi, np.pi))):
    counts, _ = np.histogram(places[:, axis], bins=3, range=(low, high))
    assert counts.sum() == 300 and counts.min() > 70  # expected 100, deviation 8
  assert {goals.count(tuple(goal)) > 70 for goal in environment.task.goals} == {True}


def test_ball_starts_in_front_in_half_of_the_episodes(room):
  environment = load("ball_push", room, random=0, image_size=None)
  task, near = environment.task, 0
  for _ in range(200):
    environment.reset()
    x, y = task.relative(task.ball_position[:2])
    near += 0.25 <= x <= 0.46 and abs(y) <= 0.09
    assert task.workspace.contains(task.ball_position[:2])
    assert task.workspace.contains(task.state.position[:2])
  assert 80 <= near <= 125  # half, and a few by chance; deviation 7


def test_a_crowded_workspace_still_gives_starts(room, monkeypatch):
  """No room in front of the robot, and free floor so rare that no drawn place hits it."""
  environment = load("ball_push", room, random=0, image_size=None)
  task = environment.task
  middle = task.workspace.center
  spots = middle + np.array([[-1.0, -1.0], [1.0, 0.9]])
  near = lambda xy: np.linalg.norm(np.asarray(xy)[..., None, :] - spots, axis=-1).min(-1) < 0.06  # noqa: E731
  monkeypatch.setattr(type(room.free_space), "is_reachable", lambda self, xy: near(xy))
  monkeypatch.setattr(task, "_in_front", lambda random_state: task.workspace.upper + 1.0)
  for _ in range(4):
    environment.reset()
    assert near(task.ball_position[:2])
    assert np.linalg.norm(task.ball_position[:2] - task.state.position[:2]) > 1.0
  monkeypatch.setattr(task, "_ball_touches_anything", lambda: True)
  with pytest.raises(composer.EpisodeInitializationError, match="is too full"):
    environment.reset()


def test_ball_pushing_succeeds_in_the_corner_cell(ball):
  task = ball.task
  target = task.workspace.target
  np.testing.assert_allclose(target - task.workspace.center, [1.0, 1.0])
  start = Start(tuple(task.workspace.center), 0.0)
  for offset, success in ((0.55, False), (0.45, True)):
    task.set_start(start, ball_xy=(target[0] - offset, target[1]))
    np.testing.assert_allclose(ball.reset().observation["goal"], target, atol=1e-6)
    ball.step(task.standing_action)
    assert task.outcome.success is success


def test_protocol_trials_can_be_set(nav, ball):
  trial = protocols.ball_wall()[3]
  ball.task.set_trial(trial)
  ball.reset()
  center = ball.task.workspace.center
  np.testing.assert_allclose(ball.task.ball_position[:2] - center, trial.ball_xy, atol=1e-9)
  np.testing.assert_allclose(ball.task.state.position[:2] - center, trial.robot_xy, atol=1e-3)
  in_furniture = trial._replace(robot_xy=tuple(np.array([2.5, -1.9]) - center))
  taken, _ = ball.task.workspace.starts(in_furniture, ball.task.scene.free_space)
  assert ball.task.scene.free_space.is_reachable(taken)
  assert ball.task.workspace.contains(taken)
  places = set()
  for trial in protocols.navigation():
    nav.task.set_trial(trial)
    nav.reset()
    assert tuple(nav.task.goal) == tuple(nav.task.goals[trial.goal])
    places.add(tuple(nav.task.state.position[:2].round(6)))
  assert len(places) == 3
  nav.task.set_trial(protocols.camera_gain()[0])
  assert nav.task.robot_camera.settings.gain == pytest.approx(128 / 50)
  nav.task.robot_camera.set_gain(1.0)


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
  ball.task.set_start(Start((-1.0, 0.0), 0.0), ball_xy=(0.0, 0.0))
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
    environment.task.set_start(Start((0.0, 0.0), 0.0))
    environment.reset()
    for _ in range(8):
      environment.step(np.where(np.arange(20) == 0, 1.0, environment.task.standing_action))
    poses[latency] = renderer.poses
  for step in range(3, 9):  # 50 ms are two control steps
    np.testing.assert_array_equal(poses[0.05][step], poses[0.0][step - 2])
  assert not np.array_equal(poses[0.0][8], poses[0.0][6])


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
    environment.task.set_start(Start((0.0, 0.0), 0.0))
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


def test_effects_change_motion_and_readings(room, tmp_path):
  path = tmp_path / "effects.json"
  value = {"value": 0.1, "low": None, "high": None, "unit": "rad"}
  path.write_text(
    json.dumps([{"kind": "encoder_offset", "target": "l_knee", "parameters": {"offset": value}}])
  )
  index = constants.JOINT_NAMES.index("l_knee")
  readings = []
  for effects in (None, path, [Effect("encoder_offset", "l_knee", {"offset": 0.1})]):
    environment = load(
      "nerf_nav", room, random=0, randomisation=NOMINAL, effects=effects, image_size=None
    )
    environment.reset()
    for _ in range(40):
      timestep = environment.step(environment.task.standing_action)
    true = environment.task.state.joints[index]
    readings.append((true, timestep.observation["joint_positions"][-1, index] - true))
  assert readings[0][1] == pytest.approx(0.0, abs=0.002)
  assert readings[1][1] == pytest.approx(0.1, abs=0.002)
  assert readings[1] == readings[2]
  assert readings[1][0] < readings[0][0] - 0.05  # the servo is deceived as well


def test_every_randomisation_has_its_switch(room):
  environment = load("ball_push", room, random=0, image_size=None)
  model = environment.physics.model.ptr
  environment.reset()
  draws = environment.task.draws
  assert 0 < draws.torso_mass <= 0.5
  torso = model.body("op3/body_link").id
  assert model.body_mass[torso] == pytest.approx(1.34928 + draws.torso_mass)
  assert model.geom("ball/geom").size[0] == draws.ball_radius != 0.12
  assert not np.array_equal(model.site("op3/imu").pos, constants.IMU_POSITION)
  assert 0.010 <= draws.camera_delay <= 0.050 and draws.jitter == 0.005
  quiet = load("ball_push", room, random=0, image_size=None, randomisation=NOMINAL)
  quiet.reset()
  model = quiet.physics.model.ptr
  assert model.body_mass[torso] == pytest.approx(1.34928)
  assert model.geom("ball/geom").size[0] == 0.12
  np.testing.assert_array_equal(model.site("op3/imu").pos, constants.IMU_POSITION)
  assert quiet.task.draws.camera_delay == 0 and not len(quiet.task.draws.pushes.start)


def test_pushes_reach_the_torso(room):
  environment = load("nerf_nav", room, random=0, image_size=None)
  environment.reset()
  start = environment.task.draws.pushes.start[0]
  force = environment.task.draws.pushes.force[0]
  torso = environment.physics.model.ptr.body("op3/body_link").id
  felt = []
  while environment.physics.time() < start + 0.04:
    environment.step(environment.task.standing_action)
    felt.append(environment.physics.data.ptr.xfrc_applied[torso, :2].copy())
  assert not np.any(felt[: int(start / 0.025) - 1])
  np.testing.assert_array_equal(felt[-1], force)


def test_bad_input_is_one_clear_error(room, tmp_path, nav):
  with pytest.raises(ValueError, match="expected one of 'nerf_nav', 'ball_push'"):
    suite.load("walk")
  with pytest.raises(ValueError, match="image_size must be"):
    load("nerf_nav", room, image_size=(0, 40))
  with pytest.raises(ValueError, match="time_limit"):
    load("nerf_nav", room, time_limit=0.0)
  with pytest.raises(ValueError, match="physics_timestep must divide"):
    load("nerf_nav", room, physics_timestep=0.002)
  with pytest.raises(ValueError, match="l_kne"):
    load("nerf_nav", room, effects=[Effect("encoder_offset", "l_kne", {"offset": 0.1})])
  with pytest.raises(ValueError, match="sequence of suite.effects.Effect, found 3"):
    load("nerf_nav", room, effects=[3])
  with pytest.raises(ValueError, match="folder of a scene bundle.*found 5"):
    suite.load("nerf_nav", scene=5)
  with pytest.raises(ValueError, match="not a folder"):
    suite.load("nerf_nav", scene=tmp_path / "nowhere")
  with pytest.raises(ValueError, match=r"shape \(20,\)"):
    nav.step(np.zeros(19))
  with pytest.raises(ValueError, match="finite"):
    nav.step(np.full(20, np.nan))
  with pytest.raises(ValueError, match="has 3 goals"):
    nav.task.set_start(None, goal_index=3)


def test_a_damaged_bundle_is_one_clear_error(tmp_path):
  broken = make_room(tmp_path)
  broken.collision_parts[3].write_text("v 0 0 0\n")
  with pytest.raises(ValueError, match="cannot build .*part_003.*make the scene's bundle again"):
    load("nerf_nav", broken)
  broken.field_path = tmp_path / "field.safetensors"
  broken.field_path.write_bytes(b"garbage" * 10)
  with pytest.raises(ValueError, match=r"field.safetensors is damaged.*make the bundle again"):
    suite.load("nerf_nav", scene=broken)


def test_a_scene_may_be_named_by_a_relative_path(tmp_path, monkeypatch):
  room = make_room(tmp_path)
  monkeypatch.chdir(tmp_path)
  room.collision_parts = [path.relative_to(tmp_path) for path in room.collision_parts]
  load("nerf_nav", room, image_size=None).reset()


def test_ball_pushing_needs_room_for_its_workspace(tmp_path):
  small = make_room(tmp_path)
  small.extent = (np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.5, 2.0]))
  with pytest.raises(ValueError, match="workspace of 3 x 3 m, found a scene of 2.00 x 2.50 m"):
    load("ball_push", small)


def test_names_are_those_of_the_modules():
  assert suite.ALL_TASKS == (nerf_nav.NAME, ball_push.NAME) == ("nerf_nav", "ball_push")
