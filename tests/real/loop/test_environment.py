"""Tests of the robot's environment on the virtual bus."""

import dataclasses

import dm_env
import numpy as np
import pytest

from nerf2real import real, suite
from nerf2real.real.loop.motion import SUPPORTED_POSE
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.safety.monitor import SafetyError, SafetySettings
from nerf2real.suite.op3 import constants
from nerf2real.suite.sensors import filters
from nerf2real.suite.tasks.state import standing_posture


class Recorder:
  """Keeps what it is given."""

  def __init__(self):
    self.calls = []

  def __getattr__(self, name):
    return lambda *args, **kwargs: self.calls.append((name, args, kwargs))

  def of(self, name):
    return [(args, kwargs) for found, args, kwargs in self.calls if found == name]


class Empty:
  """Renders an empty scene."""

  def render(self, camera, pose):
    shape = (camera.height, camera.width)
    return np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf, np.float32)


@pytest.mark.parametrize("task", suite.ALL_TASKS)
def test_observations_and_actions_are_the_simulations(robot, quick, picture, task):
  simulated = suite.load(task, privileged=False, random=0, renderer=Empty())
  connection = dataclasses.replace(robot.connection(), camera=picture)
  with real.load(task, robot=connection, settings=quick) as environment:
    assert environment.action_spec() == simulated.action_spec()
    expected, found = simulated.observation_spec(), environment.observation_spec()
    assert list(found) == list(expected)
    assert found == expected
    timestep, simulated_step = environment.reset(), simulated.reset()
    assert list(timestep.observation) == list(simulated_step.observation)
    for name, value in timestep.observation.items():
      found[name].validate(value)
      assert value.dtype == simulated_step.observation[name].dtype


def test_an_episode_of_standing(robot, load, caplog):
  caplog.set_level("INFO", "nerf2real.real.loop.environment")
  environment = load(time_limit=1.0)
  assert not robot.body.motors.enabled.any()  # nothing moves before reset
  timestep = environment.reset()
  assert timestep.first() and timestep.reward is None
  start = robot.clock.now()
  assert not robot.truth().held
  steps = 0
  while not timestep.last():
    timestep = environment.step(environment.standing_action)
    steps += 1
  assert steps == 40 and timestep.discount == 1.0
  for measured in ("time limit", "observation to goal", "imu age", "joint age", "read skew"):
    assert measured in caplog.text
  assert robot.clock.now() - start == pytest.approx(1.0, abs=0.004)
  truth = robot.truth()
  assert truth.position[2] == pytest.approx(standing_posture()[2], abs=0.005)
  seen = timestep.observation
  np.testing.assert_allclose(seen["joint_positions"][-1], truth.joints, atol=0.01)
  np.testing.assert_allclose(seen["gravity"][-1], -truth.rotation[2], atol=0.02)
  np.testing.assert_allclose(seen["accelerometer"][-1], 9.81 * truth.rotation[2], atol=0.2)
  np.testing.assert_allclose(seen["gyroscope"], 0, atol=0.1)
  assert environment.step(environment.standing_action).first()  # dm_env: a step after the last


def test_an_episode_may_have_no_end(load):
  environment = load(time_limit=float("inf"))
  environment.reset()
  assert not environment.step(environment.standing_action).last()


def test_a_robot_that_a_program_has_left_standing_is_held_before_its_torque_goes(robot, load):
  environment = load()
  environment.reset()
  environment._cycle.close()  # as the program dies
  environment._bus.close()
  seen = []
  hold = robot.operator._hold

  def note(held):
    seen.append((held, bool(robot.body.motors.enabled.all())))
    hold(held)

  robot.operator._hold = note
  load()
  assert seen == [(True, True)] and not robot.body.motors.enabled.any()
  robot.operator._hold = hold
  environment._closed = True


def test_a_key_at_the_question_to_hold_a_robot_under_torque_ends_it(robot, load):
  environment = load()
  environment.reset()
  environment._cycle.close()  # as the program dies
  environment._bus.close()
  environment._closed = True
  hold = robot.operator._hold
  robot.operator._hold = lambda held: (robot.operator.press(), hold(held))
  with pytest.raises(SafetyError, match="operator"):
    load()
  robot.truth()
  assert not robot.body.motors.enabled.any() and not robot.clock._jobs


def test_control_runs_at_40_hz_and_the_bus_at_125(robot, load):
  environment = load(time_limit=60.0)
  environment.reset()
  before = environment.bus.counts.imu_readings, environment.bus.counts.joint_readings
  start = robot.clock.now()
  for _ in range(80):
    environment.step(environment.standing_action)
  assert robot.clock.now() - start == pytest.approx(2.0, abs=0.01)
  assert environment.bus.counts.imu_readings - before[0] == pytest.approx(250, abs=2)
  assert environment.bus.counts.joint_readings - before[1] == pytest.approx(250, abs=2)
  summary = environment.timing.summary()
  assert 0 < summary["joint age"]["median"] < summary["joint age"]["max"] < 0.016
  assert summary["imu age"]["max"] < 0.012
  assert 0.002 < summary["read skew"]["median"] < 0.003
  assert "missed control deadlines" not in environment.timing.counts


def test_actions_are_filtered_and_scaled(robot, load):
  environment = load()
  environment.reset()
  pan = constants.JOINT_NAMES.index("head_pan")
  action = environment.standing_action
  action[pan] = 1.0
  expected = filters.ExponentialFilter(0.8)
  expected.reset(environment.standing_action)
  for _ in range(6):
    timestep = environment.step(action)
    control = expected(action)
    np.testing.assert_allclose(timestep.observation["previous_control"][-1], control, atol=1e-6)
    goal = robot.body.motors.goal[pan]
    assert goal == round(2048 + 0.79 * control[pan] * 4096 / (2 * np.pi))
  assert timestep.observation["previous_control"].shape == (5, 20)
  history = timestep.observation["previous_control"][:, pan]
  assert (np.diff(history) > 0).all()  # oldest first


def test_a_slow_policy_is_counted_and_not_made_up_for(robot, load):
  environment = load()
  environment.reset()
  environment.step(environment.standing_action)
  robot.clock.sleep_until(robot.clock.now() + 0.06)  # the policy thinks
  before = robot.clock.now()
  environment.step(environment.standing_action)
  assert environment.timing.counts["missed control deadlines"] == 1
  assert robot.clock.now() - before < 0.026
  environment.step(environment.standing_action)
  assert environment.timing.counts["missed control deadlines"] == 1
  assert environment.timing.summary()["observation to goal"]["max"] > 0.06


def test_start_and_end_are_slow_and_held(robot, quick, load):
  robot.body.data.qpos[robot.body._qpos] = 0.0  # the limbs hang otherwise
  held = []
  robot.operator._hold = lambda flag: (held.append(flag), robot.hold(flag))
  environment = load(settings=dataclasses.replace(quick, safety=SafetySettings()))
  start = None
  goals = []
  body = robot.body
  after = body.after_step

  def watch(time):
    after(time)
    if body.motors.enabled.all():
      goals.append(body.motors.goal.copy())

  body.after_step = watch
  environment.reset()
  assert held == [True, False]
  speed = np.abs(np.diff(np.array(goals)[::25], axis=0)).max() * 2 * np.pi / 4096 / 0.025
  assert 0.2 < speed < 1.1  # 0.5 rad/s; a window may hold two steps
  np.testing.assert_allclose(
    body.motors.goal, np.rint(2048 + SUPPORTED_POSE * 4096 / (2 * np.pi)), atol=1
  )
  action = environment.standing_action
  action[0] = 1.0
  for _ in range(20):
    environment.step(action)
  goals.clear()
  environment.close()
  assert held == [True, False, True]
  ended = np.array(goals)
  assert np.abs(np.diff(ended[::25], axis=0)).max() * 2 * np.pi / 4096 / 0.025 < 1.1
  assert not body.motors.enabled.any()
  assert start is None


def test_a_dry_run_moves_nothing(robot, load, quick):
  environment = load(settings=dataclasses.replace(quick, dry_run=True))
  tables = {
    device: bytes(servo.table.memory[:120]) for device, servo in robot.devices.servos.items()
  }
  goals = robot.body.motors.goal.copy()
  timestep = environment.reset()
  for _ in range(40):
    timestep = environment.step(np.ones(20))
  assert timestep.observation["joint_positions"].any()
  after = {
    device: bytes(servo.table.memory[:120]) for device, servo in robot.devices.servos.items()
  }
  assert after == tables  # no register of any servo was written
  assert not robot.body.motors.enabled.any()
  np.testing.assert_array_equal(robot.body.motors.goal, goals)
  assert robot.truth().held  # nobody is asked to let go of a limp robot


def test_the_goal_is_the_scenes_and_can_be_changed(load):
  environment = load(goal=1)
  np.testing.assert_allclose(environment.goal, environment.goals[1])
  environment.set_goal(np.array([0.3, -0.4]))
  assert environment.reset().observation["goal"].tolist() == pytest.approx([0.3, -0.4])
  with pytest.raises(ValueError, match="Unknown goal 7"):
    environment.set_goal(7)


def test_pictures_come_in_the_policys_size_with_their_age(load, picture):
  picture.picture[:] = np.arange(60, dtype=np.uint8)[:, None, None]
  environment = load(pictures=picture)
  seen = environment.reset().observation["camera"]
  assert seen.shape == (30, 40, 3)
  np.testing.assert_allclose(seen[:, 0, 0], np.arange(30) * 2 + 0.5, atol=0.51)  # area means
  environment.step(environment.standing_action)
  assert environment.timing.summary()["camera age"]["median"] == pytest.approx(0.03, abs=0.001)
  environment.close()
  assert picture.closed


def test_everything_is_recorded_at_full_rate(robot, load, picture):
  recorder = Recorder()
  environment = load(pictures=picture, recorder=recorder)
  environment.reset()
  recorder.calls.clear()
  start = robot.clock.wall(robot.clock.now())
  for _ in range(80):
    environment.step(environment.standing_action)
  for name, count in (("joints", 250), ("imu", 250), ("command", 80), ("image", 80)):
    assert len(recorder.of(name)) == pytest.approx(count, abs=3), name
  assert len(recorder.of("battery")) == 2 and len(recorder.of("temperature")) == 40
  (stamp, names, positions, velocities, currents, voltages, pwm), extra = recorder.of("joints")[50]
  assert names == constants.JOINT_NAMES and extra["stamps"].shape == (20,)
  assert abs(extra["stamps"].mean() - stamp) < 1e-6 and np.ptp(extra["stamps"]) > 0.002
  assert start < stamp < start + 2.1
  for values in (positions, velocities, currents, voltages, pwm):
    assert np.shape(values) == (20,)


def test_a_recording_holds_the_lens(robot, quick, load, picture, tmp_path):
  (tmp_path / "lens.yaml").write_text(
    "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
    "camera_matrix: {data: [600, 0, 320, 0, 601, 240, 0, 0, 1]}\n"
    "distortion_coefficients: {data: [0.1, -0.2, 0, 0, 0]}\n"
  )
  recorder = Recorder()
  load(pictures=picture, recorder=recorder, lens=tmp_path / "lens.yaml")
  (((_, lens), _),) = recorder.of("camera_info")
  assert (lens.width, lens.fx, lens.k2) == (640, 600.0, -0.2)
  (tmp_path / "lens.yaml").write_text("width: 640")
  with pytest.raises(ValueError, match="no camera_info YAML"):
    load(pictures=picture, recorder=recorder, lens=tmp_path / "lens.yaml")


def test_wrong_arguments_are_explained(robot, quick, load):
  with pytest.raises(ValueError, match="Unknown task 'walk'"):
    real.load("walk", robot=robot.connection())
  with pytest.raises(ValueError, match="camera is missing"):
    real.load("nerf_nav", robot=robot.connection())
  environment = load()
  environment.reset()
  with pytest.raises(ValueError, match=r"shape \(20,\)"):
    environment.step(np.zeros(19))
  environment.close()
  with pytest.raises(RuntimeError, match="closed"):
    environment.reset()


@pytest.mark.parametrize("failing", ["_motion.rest", "_cycle.close", "servos.torque"])
def test_closing_ends_everything_though_a_part_of_it_fails(
  robot, load, picture, monkeypatch, failing
):
  environment = load(pictures=picture)
  closed = []
  monkeypatch.setattr(robot.operator, "close", lambda: closed.append("operator"))
  monkeypatch.setattr(environment._bus, "close", lambda: closed.append("bus"))
  monkeypatch.setattr(environment._motion, "rest", lambda: False)

  def fail(*_):
    raise RuntimeError("the cable was pulled")

  owner, name = failing.split(".")
  monkeypatch.setattr(getattr(environment, owner), name, fail)
  with pytest.raises(RuntimeError, match="cable was pulled"):
    environment.close()
  assert closed == ["bus", "operator"] and picture.closed


def test_a_wrong_goal_leaves_nothing_running(robot, quick, picture):
  connection = dataclasses.replace(robot.connection(), camera=picture)
  with pytest.raises(ValueError, match="Unknown goal 7"):
    real.load("nerf_nav", robot=connection, settings=quick, goal=7)
  assert picture.closed and not robot.clock._jobs


def test_lost_packets_cost_readings_and_no_deadline(robot, load):
  environment = load()
  environment.reset()
  robot.faults.loss = 0.05
  before = environment.bus.counts.joint_losses
  for _ in range(200):
    timestep = environment.step(environment.standing_action)
    assert not timestep.last(), environment.stop
  lost = environment.bus.counts.joint_losses - before
  assert 0.05 < lost / 625 < 0.15  # 1 - 0.95^2 = 0.0975
  assert "missed control deadlines" not in environment.timing.counts
  assert environment.timing.summary()["joint age"]["max"] < 0.05


def test_episodes_repeat_exactly_on_a_stepped_clock():
  from nerf2real.real.virtual.robot import VirtualRobot

  seen = []
  for _ in range(2):
    with (
      VirtualRobot(stepped=True, seed=4) as robot,
      real.load(
        "nerf_nav", robot=robot.connection(), image_size=None, settings=RobotSettings(grip_time=0.1)
      ) as environment,
    ):
      environment.reset()
      for _ in range(10):
        timestep = environment.step(environment.standing_action)
      assert isinstance(timestep, dm_env.TimeStep)
      seen.append(timestep.observation)
  for name, value in seen[0].items():
    np.testing.assert_array_equal(value, seen[1][name], err_msg=name)
