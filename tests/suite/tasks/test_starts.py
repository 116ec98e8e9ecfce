"""Where episodes start, by themselves and in a protocol's trials; what is random in them."""

import json

import numpy as np
import pytest
from dm_control import composer

from nerf2real.suite import protocols
from nerf2real.suite.effects import Effect
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL
from nerf2real.suite.sensors.camera import CameraSettings
from tests.suite.tasks.small_room import load


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
  start = Pose.of(task.workspace.center, 0.0)
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


def test_the_gain_of_a_trial_multiplies_the_declared_one(room):
  environment = load("nerf_nav", room, image_size=(6, 8), camera=CameraSettings(gain=0.5))
  for trial, gain in ((protocols.navigation()[0], 0.5), (protocols.camera_gain()[0], 64 / 50)):
    environment.task.set_trial(trial)
    assert environment.task.robot_camera.settings.gain == pytest.approx(gain)


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
