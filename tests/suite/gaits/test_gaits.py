"""The legs' kinematics against MuJoCo's, and the gait's walks in simulation."""

import mujoco
import numpy as np
import pytest
from dm_control import composer, mjcf

from nerf2real import suite
from nerf2real.suite.effects import Effect
from nerf2real.suite.gaits import legs, walk
from nerf2real.suite.gaits.floor import EmptyFloor
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.pose import Pose
from nerf2real.suite.randomisation.draws import NOMINAL, RandomisationSettings

HIP_OFFSET = 0.035  # m from the middle to a hip, sideways (links.csv, hip_yaw_link)
HIP_DROP = 0.0285  # m from the torso's origin down to the hips' centre (links.csv, hip_roll_link)


@pytest.fixture(scope="module")
def posed_robot():
  arena, robot = composer.Arena(), op3.OP3()
  arena.add_free_entity(robot)
  return mjcf.Physics.from_mjcf_model(arena.mjcf_model), robot


def test_legs_put_feet_where_told(posed_robot):
  physics, robot = posed_robot
  rng = np.random.default_rng(0)
  for _ in range(10):
    ankles = [
      np.array([rng.uniform(-0.04, 0.04), side * rng.uniform(0, 0.05), -rng.uniform(0.15, 0.2)])
      for side in legs.SIDES
    ]
    yaw, pitch = rng.uniform(-0.2, 0.2, 2)
    angles = [legs.leg_angles(a, foot_roll=0.0, foot_pitch=pitch, yaw=yaw) for a in ankles]
    targets = np.zeros(len(constants.JOINT_NAMES))
    targets[legs.COLUMNS] = legs.joint_positions(*angles)
    with physics.reset_context():
      physics.bind(robot.joints).qpos = targets
    torso = physics.bind(robot.torso)
    world_from_torso = torso.xmat.reshape(3, 3)
    for ankle, foot, side in zip(ankles, robot.feet, legs.SIDES, strict=True):
      place = world_from_torso.T @ (physics.bind(foot).xpos - torso.xpos)
      turn = world_from_torso.T @ physics.bind(foot).xmat.reshape(3, 3)
      centre = place + turn @ [0.0241, 0, 0]  # links.csv: from the foot's frame to the ankle
      hip = np.array([0.0, side * HIP_OFFSET, -HIP_DROP])
      assert centre - hip == pytest.approx(ankle, abs=2e-4)  # the table's own 0.1 mm
      expected = np.zeros(9)
      quaternions = np.zeros(4), np.zeros(4), np.zeros(4)
      mujoco.mju_axisAngle2Quat(quaternions[0], np.array([0, 0, 1.0]), yaw)
      mujoco.mju_axisAngle2Quat(quaternions[1], np.array([0, 1.0, 0]), pitch)
      mujoco.mju_mulQuat(quaternions[2], quaternions[0], quaternions[1])
      mujoco.mju_quat2Mat(expected, quaternions[2])
      # Hip roll before pitch turns the foot a little more: second order.
      assert np.abs(turn.ravel() - expected).max() < 0.06


def test_places_out_of_reach_are_drawn_in():
  angles = legs.leg_angles(np.array([0.0, 0.0, -1.0]), foot_roll=0, foot_pitch=0, yaw=0)
  assert np.isfinite(angles).all() and 0 < angles[3] < 0.5


def _walk(*, effects=(), command, seconds, randomisation=NOMINAL, seed=0):
  environment = suite.load(
    "nerf_nav",
    scene=EmptyFloor(),
    effects=effects,
    image_size=None,
    random=seed,
    time_limit=seconds,
    randomisation=randomisation,
    privileged=False,
  )
  environment.task.set_start(Pose(0.0, 0.0, 0.0))
  gait, timestep = walk.Gait(), environment.reset()
  yaws = []
  while not timestep.last():
    observation = timestep.observation
    action = gait.act(
      command, gyroscope=observation["gyroscope"][-1], gravity=observation["gravity"][-1]
    )
    environment.action_spec().validate(action)
    timestep = environment.step(action)
    yaws.append(environment.task.state.yaw)
  return environment.task.state.position, float(np.unwrap(yaws)[-1]), environment.task.outcome


@pytest.mark.parametrize(
  ("effects", "randomisation"),
  [
    ((), NOMINAL),
    ((), RandomisationSettings(pushes=False)),
    (
      (
        Effect("motor_gain", None, {"gain": 0.9}),
        Effect("load_friction", None, {"coefficient": 0.15}),
        Effect("floor_friction", None, {"scale": 0.7}),
      ),
      RandomisationSettings(pushes=False),
    ),
  ],
)
def test_walks_a_metre_without_falling(effects, randomisation):
  position, yaw, outcome = _walk(
    effects=effects, randomisation=randomisation, command=walk.Command(1.0), seconds=8.0
  )
  assert outcome.ending is None and position[0] > 1.0 and abs(position[1]) < 0.4 and abs(yaw) < 0.5


@pytest.mark.parametrize("side", [1, -1])
def test_turns_on_the_spot_to_either_side(side):
  position, yaw, outcome = _walk(command=walk.Command(0.0, turn=side), seconds=4.0)
  assert outcome.ending is None and side * yaw > 1.5 and np.hypot(*position[:2]) < 0.3


def test_stands_still_when_told():
  position, yaw, outcome = _walk(command=walk.Command(step=False), seconds=3.0)
  assert outcome.ending is None and np.hypot(*position[:2]) < 0.06 and abs(yaw) < 0.1


def test_action_filter_is_inverted():
  """Targets within reach leave the task's filter exactly as the gait wants them."""
  gait = walk.Gait()
  lower, upper = constants.joint_limits()
  middle, half = (lower + upper) / 2, (upper - lower) / 2
  strength, filtered = constants.ACTION_FILTER, (constants.standing_targets() - middle) / half
  for _ in range(200):
    action = gait.act(walk.Command(0.3))
    filtered = strength * filtered + (1 - strength) * action
    wanted = gait._targets(gait.phase, gait._amplitude)
    held = np.abs(action) < 1
    error = np.abs(middle + half * filtered - np.clip(wanted, lower, upper))
    assert held.mean() > 0.5 and error[held].max() < 1e-6


def _march(gait, command, steps):
  """Steps a gait without a robot; returns actions and the controls that leave the filter."""
  control = (constants.standing_targets() - gait_middle()) / gait_half_range()
  actions, controls = [], []
  for _ in range(steps):
    actions.append(gait.act(command))
    control = constants.ACTION_FILTER * control + (1 - constants.ACTION_FILTER) * actions[-1]
    controls.append(control)
  return actions, controls


def gait_middle():
  return sum(constants.joint_limits()) / 2


def gait_half_range():
  lower, upper = constants.joint_limits()
  return (upper - lower) / 2


@pytest.mark.parametrize("offset", [7, 11])
def test_a_gait_that_follows_another_agrees_with_it(offset):
  command = walk.Command(forward=1.0, turn=0.3)
  driver, follower, idle = walk.Gait(), walk.Gait(), walk.Gait()
  _, controls = _march(driver, command, 80)
  for gait in (follower, idle):
    _march(gait, command, 80 + offset)  # walks, but out of step with the driver
  control, apart = controls[-1], []
  for _ in range(60):
    labels = [gait.act(command) for gait in (driver, follower, idle)]
    control = constants.ACTION_FILTER * control + (1 - constants.ACTION_FILTER) * labels[0]
    follower.follow(control)
    apart.append([np.abs(label - labels[0])[legs.COLUMNS].mean() for label in labels[1:]])
  apart = np.array(apart)
  assert apart[:2].mean(0).min() > 0.3  # both begin out of step
  assert apart[-40:, 0].max() < 0.1 < 0.3 < apart[-40:, 1].mean()
  difference = (follower.phase - driver.phase + np.pi) % (2 * np.pi) - np.pi
  assert abs(difference) < 0.13  # one correction of the search


def test_a_gait_follows_its_own_control_without_a_change():
  command = walk.Command(forward=0.5)
  alone, followed = walk.Gait(), walk.Gait()
  control = (constants.standing_targets() - gait_middle()) / gait_half_range()
  for _ in range(100):
    expected, action = alone.act(command), followed.act(command)
    control = constants.ACTION_FILTER * control + (1 - constants.ACTION_FILTER) * action
    followed.follow(control)
    assert action == pytest.approx(expected, abs=1e-5)


def test_the_amplitude_sinks_where_the_robot_does_not_step():
  gait, standing = walk.Gait(), walk.Gait()
  command = walk.Command(forward=1.0)
  _march(gait, command, 80)
  _, controls = _march(standing, walk.Command(step=False), 80)

  def swing(gait):
    """Spread of the legs' targets over a period."""
    pattern = [gait.pattern(p, 1.0, 0.0, 1.0) for p in np.linspace(0, 2 * np.pi, 20)]
    return np.std(pattern, axis=0).max()

  labels = []
  for _ in range(60):
    labels.append(gait.act(command))
    gait.follow(controls[-1])
  first, last = (np.std(part, axis=0)[legs.COLUMNS].max() for part in (labels[:17], labels[-17:]))
  assert swing(gait) > 0 and last < first  # it begins to step gently, not in full swing


def test_the_head_is_held_where_the_command_says():
  gait = walk.Gait()
  _, controls = _march(gait, walk.Command(step=False, head=(0.2, -0.3)), 80)
  targets = gait_middle() + gait_half_range() * controls[-1]
  head = [constants.JOINT_NAMES.index(name) for name in ("head_pan", "head_tilt")]
  assert targets[head] == pytest.approx([0.2, -0.3], abs=1e-3)
