"""Friction under weight and slip, against a biped that treads on a floor of other contacts."""

import copy
import functools

import mujoco
import numpy as np
import pytest

from nerf2real.core.robot_logs.reading import ImuSeries, JointSeries, Log
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.gaits.walk import Command, Gait
from nerf2real.suite.op3 import constants
from nerf2real.suite.op3.op3 import OP3
from nerf2real.sysid.sensors.walks import finding
from nerf2real.sysid.sensors.walks.replay import Replay, Walk, measured

STEP, READINGS, STOOD, WALKED = 0.0025, 0.0075, 1.0, 1.3  # s
COUNT = 1.5340e-3  # rad of the encoders
KNEE = Effect("load_friction", "l_knee", {"coefficient": 0.4})
SLIPPERY = Effect("floor_friction", "floor", {"scale": 0.15})
HEAVY = Effect("payload", "l_el_link", {"mass": 0.4, "x": 0.0, "y": 0.07, "z": 0.0})


def _model(*, true=False):
  return copy.copy(_compiled(true))  # effects change the model that they are bound to


@functools.cache
def _compiled(true):
  spec = mujoco.MjSpec.from_string(OP3().mjcf_model.to_xml_string())
  spec.body(constants.TORSO_LINK).add_freejoint()
  spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1])
  if true:  # what no effect of this file is
    for geom in spec.geoms:
      geom.solref[0] = 0.014
    for joint in spec.joints:
      joint.armature *= 1.04
  return spec.compile()


def _targets(forward, turn):
  """Returns joint targets [T, 20] of a gait without feedback."""
  gait = Gait()
  lower, upper = constants.joint_limits()
  rows = []
  for _ in range(round(WALKED / constants.CONTROL_TIMESTEP)):
    gait.act(Command(forward=forward, turn=turn))
    rows.append((lower + upper) / 2 + (upper - lower) / 2 * gait.control)
  return np.array(rows)


def _walk(effects, seed):
  """Returns what a robot with effects leaves of a walk in a direction of its own."""
  rng = np.random.default_rng([seed, 8])
  forward, turn = rng.uniform(-0.2, 1.0), rng.uniform(-1.0, 1.0)
  model = _model(true=True)
  model.opt.timestep = STEP
  data, stack = mujoco.MjData(model), EffectStack(effects).bind(model)
  standing, targets = constants.standing_targets(), _targets(forward, turn)
  targets += rng.normal(0, 0.004, targets.shape)
  places = model.jnt_qposadr[[model.joint(name).id for name in constants.JOINT_NAMES]]
  data.qpos[places] = standing
  data.qpos[2] = 0.25
  stack.reset()
  rows, control = [], np.zeros(model.nu)
  begun = 0.5 + STOOD
  for k in range(round((begun + WALKED) / STEP)):
    at = int((k * STEP - begun) / constants.CONTROL_TIMESTEP + 1e-6)
    control[:] = standing if k * STEP < begun else targets[min(at, len(targets) - 1)]
    stack.before_step(data, control)
    mujoco.mj_step(model, data)
    if k % round(READINGS / STEP) == 0:
      rows.append((data.time, *data.qpos[places], *data.sensordata[:6]))
  found = np.array(rows)
  time, position = found[:, 0], np.round(found[:, 1:21] / COUNT) * COUNT
  rate = found[:, 21:24] + rng.normal(0, 0.003, (len(time), 3)) + 0.01
  force = found[:, 24:27] + rng.normal(0, 0.05, (len(time), 3))
  sent = begun + constants.CONTROL_TIMESTEP * np.arange(len(targets))
  stamps = np.concatenate([[0.0], sent])
  names = constants.JOINT_NAMES
  commands = JointSeries(names, stamps, stamps, np.vstack([standing, targets]), None, None)
  log = Log(
    name="a.mcap",
    start_ns=0,
    commands=commands,
    states=JointSeries(names, time, time, position, None, None),
    pwm=None,
    imu=ImuSeries(time, time, rate, force, "imu"),
    battery=None,
    temperatures={},
  )
  return Walk(log, begun - STOOD, begun, begun + WALKED, 0.0)


@pytest.fixture(scope="module")
def before():
  """Returns walks of the robot as it was."""
  return [_walk([], seed) for seed in range(6)]


def _find(before, effects, known=()):
  model = _model()
  root = model.body(constants.TORSO_LINK).id
  now = [_walk([*effects, *known], seed) for seed in range(10, 16)]
  return finding.find(model, root, finding.Recordings(now, known), finding.Recordings(before, []))


@pytest.fixture
def few(monkeypatch):
  """Leaves four candidates of the many: of the knees and the floor."""
  every = finding.candidates

  def candidates(model, joints, known):
    kept = [c for c in every(model, joints, known) if c.target in ("l_knee", "r_knee", "floor")]
    return [c for c in kept if (c.kind, c.target) != ("motor_gain", "r_knee")]

  monkeypatch.setattr(finding, "candidates", candidates)


def test_a_walk_is_simulated_again(before):
  model = _model()
  replay = Replay(model, [], model.body(constants.TORSO_LINK).id)
  seen = np.stack([measured(walk) for walk in before])
  made = np.stack([replay.figures(walk) for walk in before])
  turned = 40 + 2  # mean rate about the torso's z
  assert np.ptp(seen[:, turned]) > 0.3
  assert made[:, turned] == pytest.approx(seen[:, turned], abs=0.06)
  assert set(replay.bearing(before[0])) == {
    f"{side}_{part}"
    for side in "lr"
    for part in ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")
  }


def test_actuators_need_not_be_called_like_their_joints():
  walk, figures = _walk([], 0), []
  spec = mujoco.MjSpec.from_string(OP3().mjcf_model.to_xml_string())
  spec.body(constants.TORSO_LINK).add_freejoint()
  spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1])
  for ending in ("", "_servo"):
    for actuator in spec.actuators:
      actuator.name += ending
    model = spec.compile()
    figures.append(Replay(model, [], model.body(constants.TORSO_LINK).id).figures(walk))
  np.testing.assert_allclose(*figures)


@pytest.mark.parametrize(
  ("effect", "parameter", "reach"), [(KNEE, "coefficient", 0.08), (SLIPPERY, "scale", 0.06)]
)
def test_what_walking_shows_is_named(before, few, effect, parameter, reach):
  part = _find(before, [effect])
  assert [(e.kind, e.target) for e in part.effects] == [(effect.kind, effect.target)]
  found = part.effects[0].parameters[parameter]
  assert found == pytest.approx(effect.parameters[parameter], abs=reach)
  low, high = part.effects[0].intervals[parameter]
  assert low < found < high
  assert part.after < 0.3 * part.before


def test_the_robot_as_it_was_has_nothing(before, few):
  part = _find(before, [])
  assert (part.rows, part.alternatives, part.notes) == ([], [], [])


def test_what_is_known_is_no_friction(before, few):
  assert _find(before, [], known=[HEAVY]).rows == []


def test_another_effect_is_no_friction(before, few):
  part = _find(before, [HEAVY])
  assert part.rows == [] and "no effect explains it" in part.notes[0]


def test_too_few_walks_are_a_note(before):
  model = _model()
  root = model.body(constants.TORSO_LINK).id
  part = finding.find(
    model, root, finding.Recordings(before[:2], []), finding.Recordings(before, [])
  )
  assert part.rows == [] and part.notes[0].startswith("Found 2 walks")
