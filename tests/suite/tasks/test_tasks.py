"""The two tasks: life cycle, observations, actions, names and bad input."""

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils

from nerf2real import suite
from nerf2real.suite.effects import Effect
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.sensors.camera import CameraSettings
from nerf2real.suite.tasks import ball_push, nerf_nav
from tests.suite.synthetic import make_room
from tests.suite.tasks.small_room import load

POLICY = {
  "gyroscope": (5, 3),
  "accelerometer": (5, 3),
  "gravity": (5, 3),
  "joint_positions": (5, 20),
  "previous_control": (5, 20),
  "goal": (2,),
  "camera": (30, 40, 3),
}


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
  nav.task.set_start(Pose(-1.0, 0.0, 0.4), goal_index=0)
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


def test_bad_input_is_one_clear_error(room, tmp_path, nav):
  with pytest.raises(ValueError, match="expected one of 'nerf_nav', 'ball_push'"):
    suite.load("walk")
  with pytest.raises(ValueError, match="image_size must be"):
    load("nerf_nav", room, image_size=(0, 40))
  with pytest.raises(ValueError, match="time_limit"):
    load("nerf_nav", room, time_limit=0.0)
  with pytest.raises(ValueError, match="time_limit must be positive and finite"):
    load("nerf_nav", room, time_limit=np.inf)
  with pytest.raises(ValueError, match="physics_timestep must divide"):
    load("nerf_nav", room, physics_timestep=0.002)
  with pytest.raises(ValueError, match="physics_timestep must be below 0.0122 s"):
    load("nerf_nav", room, physics_timestep=0.0125)
  with pytest.raises(ValueError, match="l_kne"):
    load("nerf_nav", room, effects=[Effect("encoder_offset", "l_kne", {"offset": 0.1})])
  with pytest.raises(ValueError, match="sequence of suite.effects.Effect, found 3"):
    load("nerf_nav", room, effects=[3])
  with pytest.raises(ValueError, match="sequence of suite.effects.Effect, found 3"):
    load("nerf_nav", room, effects=3)
  alone = Effect("encoder_offset", "l_knee", {"offset": 0.1})
  built = load("nerf_nav", room, image_size=None, effects=alone)
  assert built.task.settings.effects == (alone,)
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
