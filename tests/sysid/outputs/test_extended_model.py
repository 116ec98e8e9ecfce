"""model_extended.xml against the suite's operators, and opened where this project is not."""

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.sysid.model.simulation import Clocks, simulate
from nerf2real.sysid.outputs import extended_model
from tests.sysid.synthetic import ARM, PENDULUM, log_of

STEPS = 4000
TIME = 1e-3 * np.arange(STEPS)
SWEEP = 0.8 * np.minimum(TIME / 0.5, 1) * np.sin(2 * np.pi * (0.3 + 0.15 * TIME) * TIME)
SLOW = 0.5 * np.sin(2 * np.pi * 0.4 * TIME)
MOTOR = PENDULUM.replace('<position name="joint" joint="joint" kp="21"', '<motor joint="joint"')
FORCE = 2.5 * np.sin(2 * np.pi * 0.7 * TIME)


def suites(xml, effects, commands, *, read=False):
  """Returns the path that the suite's operators give, true or as it is measured [T]."""
  model = mujoco.MjModel.from_xml_string(xml)
  stack, data = EffectStack(effects).bind(model), mujoco.MjData(model)
  stack.reset()
  path = np.zeros(STEPS)
  for index in range(STEPS):
    stack.before_step(data, np.full(model.nu, commands[index]))
    mujoco.mj_step(model, data)
    path[index] = data.qpos[0]
    if read:
      path[index] = stack.observe("joint_positions", data.qpos.copy(), data.time)[0]
  return path


def natives(path, commands, value=lambda data: data.qpos[0], *, start=0.0):
  """Returns the path that plain MuJoCo gives, from positions `start` on."""
  model = mujoco.MjModel.from_xml_path(str(path))
  data = mujoco.MjData(model)
  data.qpos[:] = start
  result = np.zeros(STEPS)
  for index in range(STEPS):
    data.ctrl[:] = commands[index]
    mujoco.mj_step(model, data)
    result[index] = value(data)
  return result


def written(tmp_path, xml, effects):
  (tmp_path / "model.xml").write_text(xml)
  left = extended_model.write(tmp_path / "model.xml", tmp_path / "extended.xml", effects)
  return tmp_path / "extended.xml", left


def rms(values):
  return float(np.sqrt(np.mean(np.square(values[300:-1]))))


@pytest.mark.parametrize(
  ("effect", "commands", "share"),
  [
    (Effect("command_delay", "joint", {"delay": 0.0234}), SWEEP, 1e-6),
    (Effect("asymmetric_friction", "joint", {"positive": 0.3, "negative": 0.1}), SWEEP, 1e-6),
    (Effect("cogging", "joint", {"amplitude": 0.3, "periods": 12.0, "phase": 0.7}), SWEEP, 1e-6),
    (Effect("stribeck_friction", "joint", {"breakaway": 0.4, "velocity": 1.0}), SLOW, 0.02),
  ],
  ids=lambda value: getattr(value, "kind", ""),
)
def test_native_effects_move_as_the_suites(effect, commands, share, tmp_path):
  path, left = written(tmp_path, PENDULUM, [effect])
  assert left == []
  want, declared = suites(PENDULUM, [effect], commands), suites(PENDULUM, [], commands)
  changed = rms(want - declared)
  assert changed > 2e-3
  assert rms(natives(path, commands) - want) < share * changed


@pytest.mark.parametrize("stribeck", [False, True])
def test_contacts_that_bend_are_bristles(stribeck, tmp_path):
  rigid = [Effect("coulomb_friction", "joint", {"torque": 0.3})]
  if stribeck:
    rigid.append(Effect("stribeck_friction", "joint", {"breakaway": 0.2, "velocity": 0.5}))
  bends = [*rigid, Effect("presliding", "joint", {"reach": 0.02})]
  path, left = written(tmp_path, PENDULUM, bends)
  assert left == []
  want = suites(PENDULUM, bends, SLOW)
  changed = rms(want - suites(PENDULUM, rigid, SLOW))
  assert changed > 2e-3
  assert rms(natives(path, SLOW) - want) < 0.05 * changed


def test_logs_are_simulated_in_the_file_as_in_the_suite(tmp_path):
  # Bristles are actuators that take no command: there are more of them than commands.
  effects = [
    Effect("coulomb_friction", "joint", {"torque": 0.3}),
    Effect("stribeck_friction", "joint", {"breakaway": 0.4, "velocity": 1.0}),
    Effect("presliding", "joint", {"reach": 0.01}),
  ]
  filtered = PENDULUM.replace("<position ", '<position timeconst="0.01" ')
  path, left = written(tmp_path, filtered, effects)
  assert left == []
  log = log_of(filtered, "slow", effects, duration=4.0, rounding=0.0)
  got = simulate(mujoco.MjModel.from_xml_path(str(path)), log, [])
  declared = simulate(mujoco.MjModel.from_xml_string(filtered), log, [])
  want = log.states.position
  changed = np.std(declared - want)
  assert changed > 2e-3
  assert np.std(got - want) < 0.02 * changed


def test_a_gain_of_position_alone_is_written_with_the_servos_own_damping(tmp_path):
  damped = PENDULUM.replace('kp="21"', 'kp="21" kv="0.8"')
  gain = Effect("motor_gain", "joint", {"gain": 0.6, "position_alone": 1.0})
  path, left = written(tmp_path, damped, [gain])
  assert left == []
  assert rms(natives(path, SWEEP) - suites(damped, [gain], SWEEP)) < 1e-9
  whole = Effect("motor_gain", "joint", {"gain": 0.6})
  assert rms(natives(path, SWEEP) - suites(damped, [whole], SWEEP)) > 1e-3


@pytest.mark.parametrize(
  "effect",
  [
    Effect("motor_gain", "elbow", {"gain": 0.6}),
    Effect("payload", "lower", {"mass": 0.3, "x": 0.0, "y": 0.0, "z": -0.1}),
    Effect("parameter_error", "elbow", {"mass": 1.2, "armature": 1.3}),
  ],
  ids=lambda effect: effect.kind,
)
def test_a_servo_keeps_its_damping_and_a_body_its_axes_however_they_are_declared(effect, tmp_path):
  other = ARM.replace('kp="21"', 'kp="21" dampratio="0.7"')
  diagonal = 'diaginertia="8e-4 8e-4 1e-4"'
  other = other.replace(diagonal, 'fullinertia="8e-4 8e-4 4e-4 1e-4 0 -1e-4"')
  path, left = written(tmp_path, other, [effect])
  assert left == []
  want, got = mujoco.MjModel.from_xml_string(other), mujoco.MjModel.from_xml_path(str(path))
  EffectStack([effect]).bind(want)
  np.testing.assert_allclose(got.actuator_biasprm, want.actuator_biasprm, rtol=1e-5)
  if effect.kind != "payload":  # which is a body of its own
    np.testing.assert_allclose(got.body("lower").inertia, want.body("lower").inertia, rtol=1e-5)


def test_late_readings_are_late_sensors(tmp_path):
  effect = Effect("measurement_delay", "joint", {"delay": 0.0234})
  path, left = written(tmp_path, PENDULUM, [effect])
  assert left == []
  want = suites(PENDULUM, [effect], SWEEP, read=True)
  got = natives(path, SWEEP, lambda data: data.sensor("joint_position_late").data[0])
  # MuJoCo computes sensors before it steps: of the state that the suite observed one step ago.
  assert rms(got[1:] - want[:-1]) < 1e-9


def test_play_on_an_effort_is_two_joints(tmp_path):
  effect = Effect("backlash", "joint", {"gap": 0.03})
  path, left = written(tmp_path, MOTOR, [effect])
  assert left == []
  side = [0.015, -0.015]  # where the suite begins
  got = natives(path, FORCE, lambda data: data.qpos.sum(), start=side)
  want, declared = suites(MOTOR, [effect], FORCE), suites(MOTOR, [], FORCE)
  assert rms(want - declared) > 5e-3
  # Teeth bounce in microradians that differ; both stay by the play of one another.
  assert rms(got - want) < 0.2 * rms(want - declared)
  play = natives(path, FORCE, lambda data: data.qpos[1])
  assert 0.015 < np.abs(play).max() < 0.022  # the teeth give way under load


def test_a_servos_play_is_written_only_behind_its_encoder(tmp_path):
  outside = Effect("backlash", "joint", {"gap": 0.02})
  path, left = written(tmp_path, PENDULUM, [outside])
  assert left == [outside]
  assert "Not in this model: backlash on joint (gap 0.02)." in path.read_text()
  inside = outside.replace(encoder_on_motor=1.0)
  path, left = written(tmp_path, PENDULUM, [inside])
  assert left == []
  want = suites(PENDULUM, [inside], SLOW)
  got = natives(path, SLOW, lambda data: data.qpos.sum())
  assert rms(got - want) < 0.1 * rms(want - suites(PENDULUM, [], SLOW))


def test_a_play_of_no_gap_is_no_joint(tmp_path):
  path, left = written(tmp_path, MOTOR, [Effect("backlash", "joint", {"gap": 0.0})])
  assert left == []
  assert mujoco.MjModel.from_xml_path(str(path)).njnt == 1


def test_effects_on_all_joints_and_several_kinds_together(tmp_path):
  effects = [
    Effect("cogging", "elbow", {"amplitude": 0.2}),
    Effect("command_delay", None, {"delay": 0.011}),
    Effect("asymmetric_friction", "shoulder", {"positive": 0.3, "negative": 0.2}),
    Effect("payload", "lower", {"mass": 0.1, "x": 0.0, "y": 0.0, "z": -0.1}),
  ]
  path, left = written(tmp_path, ARM, effects)
  assert left == []
  want, declared = suites(ARM, effects, SWEEP), suites(ARM, [], SWEEP)
  assert rms(natives(path, SWEEP) - want) < 0.02 * rms(want - declared)


def test_what_mjcf_cannot_hold_is_listed_in_the_file(tmp_path):
  load = Effect("load_friction", "joint", {"coefficient": 0.2})
  late = Effect("command_delay", "joint", {"delay": 0.02})
  path, left = written(tmp_path, PENDULUM, [load, late])
  assert left == [load]
  text = path.read_text()
  assert "Not in this model: load_friction on joint (coefficient 0.2)." in text
  assert text.index("<!--") < text.index("-->") < text.index("<worldbody>")


def test_latencies_that_are_no_effects_are_named_in_the_file(tmp_path):
  (tmp_path / "model.xml").write_text(PENDULUM)
  target = tmp_path / "extended.xml"
  late = {"joint": Clocks(skew=9e-4, latency=2.8e-3)}
  extended_model.write(tmp_path / "model.xml", target, [], clocks=late)
  assert "a command of joint takes 2.8 ms, a reading is 0.9 ms old" in target.read_text()
  extended_model.write(tmp_path / "model.xml", target, [], clocks={"joint": Clocks()})
  assert "takes" not in target.read_text()


def test_plain_mujoco_opens_the_file_without_this_project(tmp_path):
  effects = [
    Effect("command_delay", "joint", {"delay": 0.02}),
    Effect("stribeck_friction", "joint", {"breakaway": 0.2, "velocity": 0.1}),
    Effect("cogging", "joint", {"amplitude": 0.1}),
    Effect("measurement_delay", "joint", {"delay": 0.01}),
    Effect("backlash", "joint", {"gap": 0.01, "encoder_on_motor": 1.0}),
  ]
  path, left = written(tmp_path, PENDULUM, effects)
  assert left == []
  program = """
import sys
import mujoco
sys.modules["nerf2real"] = None  # its import would fail
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
data.ctrl[0] = 0.5
for _ in range(1000):
  mujoco.mj_step(model, data)
print(model.nu, model.nq, data.qpos.sum())
"""
  run = subprocess.run(
    [sys.executable, "-I", "-c", program, str(path)],
    capture_output=True,
    text=True,
    cwd=tmp_path,
    check=False,
  )
  assert run.returncode == 0, run.stderr
  inputs, positions, place = run.stdout.split()
  assert (inputs, positions) == ("1", "2")  # friction and cogging take no command
  assert 0.2 < float(place) < 0.5


def test_an_unknown_joint_is_one_clear_error(tmp_path):
  with pytest.raises(ValueError, match="no joint 'knee' in the model for cogging"):
    written(tmp_path, PENDULUM, [Effect("cogging", "knee", {"amplitude": 0.1})])


def test_the_file_keeps_the_declared_name(tmp_path):
  path, _ = written(tmp_path, PENDULUM, [])
  assert Path(path).read_text().startswith('<mujoco model="pendulum">')
