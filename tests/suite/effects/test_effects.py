"""The protocol of effects: nominal ones change nothing, files, names, what is measured."""

import functools
import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nerf2real.suite import effects as effects_package
from nerf2real.suite.effects import (
  KINDS,
  Effect,
  EffectStack,
  Parameter,
  kind_of,
  read_effects,
  write_effects,
)
from tests.suite.effects.rolling import rollout

# Two joints with position servos, one with a motor, and a ball on a floor.
_MODEL = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -1"/>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping=".05" armature=".002" frictionloss=".01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/>
      <body name="fore" pos="0 0 -.2">
        <joint name="elbow" axis="0 1 0" damping=".02" armature=".001" stiffness=".1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2"/>
        <body name="hand" pos="0 0 -.2">
          <joint name="slide" type="slide" axis="0 0 1" damping="3"/>
          <geom type="box" size=".02 .03 .02" pos=".01 0 0" mass=".1"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="1 0 -.88"><freejoint/><geom name="ball" size=".12" mass=".6"/></body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="8" forcerange="-2 2" ctrlrange="-2 2"/>
    <position joint="elbow" kp="4" kv=".05"/>
    <motor joint="slide"/>
  </actuator>
</mujoco>
"""
_COUNT = 300
_TARGETS = {"joint": None, "none": None, "body": "fore", "geom": "ball"}


def _model():
  return mujoco.MjModel.from_xml_string(_MODEL)


def _controls():
  time = 0.002 * np.arange(_COUNT)[:, None]
  return np.array([0.8, -0.6, 2.0]) * np.sin(2 * np.pi * time * np.array([1.0, 1.7, 2.3]))


def _arrays(model):
  names = [n for n in dir(model) if isinstance(getattr(model, n), np.ndarray)]
  return {n: getattr(model, n).copy() for n in names} | {"gravity": model.opt.gravity.copy()}


def _state(model, effects):
  stack = EffectStack(effects).bind(model)
  data = mujoco.MjData(model)
  rollout(stack, data, _controls())
  return np.concatenate([data.qpos, data.qvel, data.actuator_force])


@functools.cache
def _nominal():
  model = _model()
  data = mujoco.MjData(model)
  for ctrl in _controls():
    data.ctrl[:] = ctrl
    mujoco.mj_step(model, data)
  return np.concatenate([data.qpos, data.qvel, data.actuator_force])


def _plausible(parameter: Parameter):
  return parameter.low + 0.8 * (parameter.high - parameter.low)


def _strong(name):
  """Returns the kind's effect with every parameter well inside its range, not nominal."""
  kind = kind_of(name)
  parameters = {p.name: _plausible(p) for p in kind.parameters if not p.shape and not p.is_list}
  if name == "residual_force":
    parameters = {"weights": [0.3] * 25}
  if name == "torque_limit":
    parameters = {"limit": 0.2}
  if name == "parameter_error":
    parameters = {"damping": 1.5}
  if name == "payload":
    parameters = {"mass": 0.2, "x": 0.05}
  return Effect(name, _TARGETS[kind.target], parameters)


@pytest.mark.parametrize("name", KINDS)
def test_nominal_effect_is_bit_identical_and_a_real_one_is_not(name):
  kind = kind_of(name)
  nominal = Effect(name, _TARGETS[kind.target], kind.nominal())
  np.testing.assert_array_equal(_state(_model(), [nominal]), _nominal())
  if kind.acts != "measurement" and name != "floor_slope":
    assert np.abs(_state(_model(), [_strong(name)]) - _nominal()).max() > 1e-6


@pytest.mark.parametrize("name", KINDS)
def test_unbind_restores_the_model_bit_for_bit(name):
  model = _model()
  before = _arrays(model)
  effect = _strong(name)
  if name == "floor_slope":
    effect = Effect(name, "floor", {"x": 0.1})
  stack = EffectStack([effect]).bind(model)
  rollout(stack, mujoco.MjData(model), _controls()[:100])
  changed = [n for n, v in _arrays(model).items() if not np.array_equal(v, before[n])]
  if kind_of(name).acts == "model":
    assert changed and stack.is_constant
  stack.unbind()
  for field, value in _arrays(model).items():
    np.testing.assert_array_equal(value, before[field], err_msg=field)


def test_all_effects_at_once_stay_finite_and_reset_repeats():
  model = _model()
  stack = EffectStack([_strong(name) for name in KINDS if name != "floor_slope"]).bind(model)
  runs = []
  for _ in range(2):
    data = mujoco.MjData(model)
    stack.reset()
    runs.append(rollout(stack, data, _controls())[0])
    assert np.isfinite(data.qpos).all() and not any(w.number for w in data.warning)
  np.testing.assert_array_equal(runs[0], runs[1])


@pytest.mark.parametrize("name", sorted(KINDS))
def test_reset_leaves_nothing_of_the_last_step_in_the_model(name):
  model = _model()
  effect = _strong(name)
  if name == "supply_sag":
    effect = effect.replace(scales_limit=1.0)
  stack = EffectStack([effect]).bind(model)
  bound = _arrays(model)
  rollout(stack, mujoco.MjData(model), _controls()[:100])
  stack.reset()
  for field, value in _arrays(model).items():
    np.testing.assert_array_equal(value, bound[field], err_msg=field)


def test_registry_is_complete_and_consistent():
  issue = """command_delay measurement_delay clock_drift coulomb_friction viscous_friction
    stribeck_friction load_friction asymmetric_friction quadratic_drag backlash encoder_offset
    motor_gain supply_sag torque_limit thermal_derating payload spring cogging gravity_tilt
    parameter_error imu_bias imu_tilt imu_lag imu_scale camera_gain camera_latency camera_focal
    floor_slope floor_friction rolling_resistance residual_force presliding"""
  assert set(issue.split()) == set(KINDS)
  for kind in KINDS.values():
    assert kind.target in _TARGETS
    for p in kind.parameters:
      assert p.low < p.high and p.minimum <= p.low and p.high <= p.maximum
      assert p.low <= p.nominal <= p.high or p.nominal == np.inf


def test_effects_on_one_joint_leave_the_others_alone():
  model = _model()
  before = model.dof_damping.copy()
  both = [
    Effect("viscous_friction", None, {"coefficient": 0.5}),
    Effect("viscous_friction", "elbow", {"coefficient": 0.2}),
  ]
  EffectStack(both).bind(model)
  np.testing.assert_allclose(model.dof_damping - before, [0.5, 0.2, 0.5, *[0] * 6])
  with pytest.raises(ValueError, match=r"two effects .* 'elbow'"):
    EffectStack([both[1], both[1]]).bind(_model())


def test_command_delay_differs_by_joint():
  delays = [
    Effect("command_delay", "elbow", {"delay": 0.005}),
    Effect("command_delay", "slide", {"delay": 0.004}),
  ]
  stack = EffectStack(delays).bind(_model())
  data = mujoco.MjData(stack.binding.model)
  seen = []
  for ctrl in range(6):
    stack.before_step(data, np.full(3, float(ctrl)))
    seen.append(data.ctrl.tolist())
  np.testing.assert_allclose(
    seen, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0.5, 1], [4, 1.5, 2], [5, 2.5, 3]]
  )


def test_joint_order_of_the_caller():
  effect = Effect("encoder_offset", "elbow", {"offset": 0.1})
  stack = EffectStack([effect]).bind(_model(), joints=["slide", "elbow"])
  np.testing.assert_allclose(stack.observe("joint_positions", np.zeros(2), 0.0), [0, 0.1])


def test_measurement_delay_interpolates():
  delays = [
    Effect("measurement_delay", "shoulder", {"delay": 0.012}),
    Effect("measurement_delay", "elbow", {"delay": 0.03}),
  ]
  stack = EffectStack(delays).bind(_model())
  for step in range(1200):
    time = 0.008 * step
    seen = stack.observe("joint_positions", np.full(3, 2 * time), time)
    # A ramp of 2 rad/s read late, from 0 on.
    late = 2 * np.maximum(0, time - np.array([0.012, 0.03, 0.0]))
    np.testing.assert_allclose(seen, late, atol=1e-9)
  stack.reset()
  assert stack.observe("joint_positions", np.ones(3), 0.0)[0] == 1.0


def test_clock_drift_stamps():
  stack = EffectStack([Effect("clock_drift", None, {"rate": 1e-3})]).bind(_model())
  assert stack.stamp(10.0) == pytest.approx(10.01)


def test_imu_effects():
  effects = [
    Effect("imu_tilt", None, {"z": np.pi / 2}),
    Effect("imu_scale", None, {"gyroscope": 1.1, "accelerometer": 0.9}),
    Effect("imu_bias", None, {"gyroscope_x": 0.01, "accelerometer_z": -0.2}),
  ]
  stack = EffectStack(effects).bind(_model())
  # Turned by 90 degrees about z: what was along y is read along x.
  gyroscope = stack.observe("gyroscope", np.array([1.0, 2.0, 3.0]), 0.0)
  np.testing.assert_allclose(gyroscope, [2.2 + 0.01, -1.1, 3.3])
  accelerometer = stack.observe("accelerometer", np.array([0.0, 0.0, 9.81]), 0.0)
  np.testing.assert_allclose(accelerometer, [0, 0, 9.81 * 0.9 - 0.2], atol=1e-12)


def test_imu_lag_is_a_delay_and_an_exponential():
  stack = EffectStack([Effect("imu_lag", None, {"delay": 0.02, "time_constant": 0.05})])
  stack.bind(_model())
  stack.observe("gyroscope", np.zeros(3), 0.0)
  for step in range(1, 60):
    time = 0.01 * step
    # A step to 1 between 0.1 and 0.11 s arrives 20 ms later.
    seen = stack.observe("gyroscope", np.full(3, float(step > 10)), time)
    expected = 1 - np.exp(-(time - 0.12) / 0.05) if step > 12 else 0.0
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_camera_effects():
  picture = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)

  def see(kind, **parameters):
    stack = EffectStack([Effect(kind, None, parameters)]).bind(_model())
    return stack.observe("camera", picture, 0.0)

  np.testing.assert_array_equal(see("camera_gain", gain=0.5), np.rint(picture * 0.5))
  bright = see("camera_gain", gain=2.56)
  assert bright.dtype == np.uint8 and bright.max() == 255
  assert see("camera_focal", scale=1.0) is picture
  # A ramp magnified twice about the centre column 19.5 rises half as fast.
  ramp = np.broadcast_to((5 * np.arange(40, dtype=np.uint8))[None, :, None], (30, 40, 3))
  stack = EffectStack([Effect("camera_focal", None, {"scale": 2.0})]).bind(_model())
  seen = stack.observe("camera", ramp, 0.0)[15, :, 0].astype(float)
  np.testing.assert_allclose(seen, 5 * (19.5 + (np.arange(40) - 19.5) / 2), atol=1.01)
  stack = EffectStack([Effect("camera_latency", None, {"delay": 0.06})]).bind(_model())
  frames = [
    int(stack.observe("camera", np.full((2, 2, 3), k, np.uint8), 0.025 * k)[0, 0, 0])
    for k in range(6)
  ]
  assert frames == [0, 0, 0, 0, 1, 2]


def test_files_round_trip(tmp_path):
  effects = [
    Effect("command_delay", None, {"delay": 0.02}, {"delay": (0.018, 0.022)}),
    Effect("residual_force", "elbow", {"weights": [0.1] * 25}),
    Effect("torque_limit", "shoulder", {"limit": 1.5}),
  ]
  path = tmp_path / "effects.json"
  write_effects(path, effects)
  assert read_effects(path) == effects
  entry = json.loads(path.read_text())[0]
  assert entry == {
    "kind": "command_delay",
    "target": None,
    "parameters": {"delay": {"value": 0.02, "low": 0.018, "high": 0.022, "unit": "s"}},
  }
  assert EffectStack(read_effects(path)).bind(_model()).effects == effects


def _entry(kind="viscous_friction", target="elbow", **parameter):
  value = {"value": 0.1, "unit": "N m s/rad", **parameter}
  return {"kind": kind, "target": target, "parameters": {"coefficient": value}}


@pytest.mark.parametrize(
  ("content", "message"),
  [
    ([_entry(kind="stiction")], r"kind 'stiction'.*viscous_friction"),
    ([_entry(unit="N m")], r"unit 'N m'.*N m s/rad or N s/m"),
    ([_entry(value="a lot")], r"'a lot'.*expected a number"),
    ([_entry(value=-1.0)], r"-1.0.*expected a finite number from 0"),
    ([_entry(value=True)], r"True.*expected a number"),
    ([{"kind": "spring", "parameters": {"k": {"value": 1}}}], r"'k'.*stiffness"),
    ([{"kind": "spring", "parameters": {"stiffness": 1}}], r"expected an object with value"),
    ([{"target": "elbow"}], r"expected an object with kind"),
    ([_entry(target=3)], r"target 3"),
    ({"kind": "spring"}, r"expected a list"),
    ([_entry(low="0.05", high=0.2)], r"bound '0.05'.*expected a number or null"),
    ([_entry(low=float("nan"), high=0.2)], r"bound nan.*expected a number or null"),
    ([_entry(samples=[])], r"\[\] as samples.*one or more"),
  ],
)
def test_wrong_files_say_what_is_wrong(tmp_path, content, message):
  path = tmp_path / "effects.json"
  path.write_text(json.dumps(content))
  with pytest.raises(ValueError, match=message):
    read_effects(path)


def test_missing_and_damaged_files(tmp_path):
  with pytest.raises(FileNotFoundError, match="expected a list of effects"):
    read_effects(tmp_path / "none.json")
  (tmp_path / "half.json").write_text('[{"kind": "spr')
  with pytest.raises(ValueError, match="no valid JSON"):
    read_effects(tmp_path / "half.json")
  (tmp_path / "nan.json").write_text(json.dumps([_entry(value=float("nan"))]))
  with pytest.raises(ValueError, match="nan"):
    read_effects(tmp_path / "nan.json")


def test_a_slide_joint_may_use_its_own_units(tmp_path):
  path = tmp_path / "effects.json"
  path.write_text(json.dumps([_entry(target="slide", unit="N s/m")]))
  assert read_effects(path)[0].parameters == {"coefficient": 0.1}


@pytest.mark.parametrize("kind", ["gravity_tilt", "floor_slope", "imu_tilt"])
def test_what_the_world_turns_by_is_no_slide_joint_s_length(kind):
  assert kind_of(kind).parameter("x").units() == ("rad",)


@pytest.mark.parametrize(
  ("effect", "message"),
  [
    (Effect("coulomb_friction", "elbw", {"torque": 0.1}), r"'elbw'.*did you mean \['elbow'\]"),
    (Effect("motor_gain", "wrist", {"gain": 0.9}), r"'wrist'.*\['shoulder', 'elbow', 'slide'\]"),
    (Effect("payload", "fure", {"mass": 0.1}), r"body named 'fure'.*fore"),
    (Effect("payload", None, {"mass": 0.1}), r"payload without a target"),
    (Effect("floor_slope", "flor", {"x": 0.1}), r"geom named 'flor'.*floor"),
    (Effect("residual_force", "elbow", {"weights": [1.0, 2.0]}), r"2 weights.*25"),
    (Effect("supply_sag", "elbow", {"droop": 0.1}), r"no target"),
  ],
)
def test_wrong_targets_name_what_would_be_right_and_leave_the_model_alone(effect, message):
  model = _model()
  before = _arrays(model)
  spoil = Effect("viscous_friction", None, {"coefficient": 1.0})
  with pytest.raises(ValueError, match=message):
    EffectStack([spoil, effect]).bind(model)
  for field, value in _arrays(model).items():
    np.testing.assert_array_equal(value, before[field], err_msg=field)


def test_an_unbound_stack_says_so():
  with pytest.raises(ValueError, match="bind"):
    EffectStack().before_step(None, np.zeros(1))


def test_the_readme_example_runs(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  readme = Path(effects_package.__file__).with_name("README.md").read_text()
  example = re.search(r"```python\n(.*?)```", readme, re.DOTALL).group(1)
  names: dict = {}
  exec(example, names)
  assert (tmp_path / "effects.json").exists()
  # 30 ms late, friction against it, but on its way to 0.5.
  assert 0.05 < names["seen"][0] < 0.6
