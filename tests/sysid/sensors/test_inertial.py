"""The IMU's effects against readings of a swinging rod, from the formulas of rigid-body motion."""

import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.reading import read_log
from nerf2real.core.robot_logs.writer import open_log
from nerf2real.sysid.sensors import inertial, sensing
from tests.sysid import imu_machines

START = 1_700_000_000_000_000_000
LENGTH = 0.3  # m from the hinges' crossing to the IMU
MODEL = """
<mujoco><worldbody><body><joint name="swing" axis="0 1 0"/><geom size=".02" mass=".1"/>
<body><joint name="turn" axis="0 0 1"/><geom size=".02" pos="0 0 -.2" mass=".1"/>
<site name="imu" pos="0 0 -0.3"/></body></body></worldbody>
<actuator><position joint="swing" kp="5"/><position joint="turn" kp="5"/></actuator>
<sensor><gyro name="gyroscope" site="imu"/><accelerometer name="accelerometer" site="imu"/></sensor>
</mujoco>"""


def _angles(t, still):
  """Returns angles, rates and accelerations of the two hinges [2, N] at times [N]."""
  parts = [(0.7, 2 * np.pi * 0.6, 0.0), (0.9, 2 * np.pi * 0.37, 1.0)]
  if still:
    return np.zeros((3, 2, len(t)))
  q = np.array([a * np.sin(w * t + p) for a, w, p in parts])
  v = np.array([a * w * np.cos(w * t + p) for a, w, p in parts])
  return q, v, np.array([-a * w * w * np.sin(w * t + p) for a, w, p in parts])


def _ideal(t, still):
  """Returns rates and specific force [N, 6] in the frame of an IMU on the axis of the turn."""
  q, v, a = _angles(t, still)
  cos, sin = np.cos(q[0]), np.sin(q[0])
  # In the frame of the swing: rod along -z, swing about y.
  force = np.stack([-LENGTH * a[0] - 9.81 * sin, 0 * sin, LENGTH * v[0] ** 2 + 9.81 * cos], axis=1)
  rate = np.stack([0 * sin, v[0], v[1]], axis=1)
  back = Rotation.from_euler("z", -q[1][:, None])
  return np.hstack([back.apply(rate), back.apply(force)])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
  """Logs of the rod in motion and at rest, read from files: their IMU reads zeros."""
  found = {}
  for still in (False, True):
    path = tmp_path_factory.mktemp("logs") / "rod.mcap"
    with open_log(path) as log:
      for n in range(1000):
        q = np.round(_angles(np.array([n * 0.01]), still)[0][:, 0] / 0.001534) * 0.001534
        stamp = START + n * 10_000_000
        for topic in (messages.COMMANDS, messages.STATES):
          log.write(messages.joint_state(stamp, topic, ("swing", "turn"), position=q))
        log.write(messages.imu(stamp + 2_000_000, np.zeros(3), np.zeros(3)))
    found[still] = read_log(path)
  return found


@pytest.fixture
def made(recorded):
  """Makes a log of the rod whose IMU has effects and noise."""

  def make(*, seed=0, still=False, tilt=(0, 0, 0), scale=(1, 1), bias=(0,) * 6, late=0.0):
    log, turn = recorded[still], Rotation.from_rotvec(tilt).inv()
    ideal = _ideal(np.arange(1000) * 0.01 + 0.002 - late, still)
    seen = np.hstack([turn.apply(ideal[:, :3]) * scale[0], turn.apply(ideal[:, 3:]) * scale[1]])
    noise = np.random.default_rng(seed).normal(0, 1, (1000, 6)) * [*(0.003,) * 3, *(0.05,) * 3]
    seen = seen + bias + noise
    imu = dataclasses.replace(
      log.imu, angular_velocity=seen[:, :3], linear_acceleration=seen[:, 3:]
    )
    return dataclasses.replace(log, imu=imu)

  return make


def _found(made, **effects):
  logs = [made(seed=i, **effects) for i in range(2)]
  return inertial.find(mujoco.MjModel.from_xml_string(MODEL), logs)


@pytest.mark.parametrize(
  ("effects", "kind", "values"),
  [
    ({"bias": (0.02, 0, -0.01, 0, 0, 0)}, "imu_bias", {"gyroscope_x": 0.02, "gyroscope_z": -0.01}),
    ({"bias": (0, 0, 0, 0, 0.5, 0)}, "imu_bias", {"accelerometer_y": 0.5}),
    ({"tilt": (0.06, 0.0, -0.04)}, "imu_tilt", {"x": 0.06, "y": 0.0, "z": -0.04}),
    ({"scale": (1.06, 1.0)}, "imu_scale", {"gyroscope": 1.06}),
    ({"scale": (1.0, 0.95)}, "imu_scale", {"accelerometer": 0.95}),
    ({"late": 0.03}, "imu_lag", {"delay": 0.03}),
  ],
)
def test_an_effect_is_named_with_its_size(effects, kind, values, made):
  found = _found(made, **effects)
  assert [e.kind for e in found.effects] == [kind]
  for name, value in values.items():
    unit = found.rows[0]["parameters"][name]["unit"]
    close = {"rad/s": 0.001, "m/s^2": 0.05, "rad": 0.003, "1": 0.008, "s": 0.001}[unit]
    assert found.effects[0].parameters[name] == pytest.approx(value, abs=close)
  assert found.after < 0.9 * found.before


def test_an_ideal_imu_is_not_accused(made):
  assert _found(made).effects == []


def test_two_effects_are_both_named(made):
  found = _found(made, late=0.02, bias=(0, 0.03, 0, 0, 0, 0))
  assert {e.kind for e in found.effects} == {"imu_lag", "imu_bias"}


def test_of_an_imu_at_rest_tilt_and_bias_are_not_told_apart(made):
  found = _found(made, still=True, bias=(0, 0, 0, 0.6, 0, 0))
  assert found.effects == []
  assert {a["kind"] for a in found.alternatives} >= {"imu_tilt", "imu_bias"}


def test_an_imu_on_a_body_that_stands_still_has_a_zero_of_its_gyroscope(made):
  base = '<body><geom size=".1" mass="1"/><site name="imu"/><body>'
  fixed = MODEL.replace('<site name="imu" pos="0 0 -0.3"/>', "").replace(
    "<worldbody><body>", f"<worldbody>{base}"
  )
  fixed = fixed.replace("</body></body></worldbody>", "</body></body></body></worldbody>")
  bias = (0.02, 0, 0, 0, 0, 0)
  log = made(still=True, bias=bias)
  found = inertial.find(mujoco.MjModel.from_xml_string(fixed), [log])
  assert [e.kind for e in found.effects] == ["imu_bias"]
  assert set(found.effects[0].parameters) == {"gyroscope_x", "gyroscope_y", "gyroscope_z"}
  assert found.effects[0].parameters["gyroscope_x"] == pytest.approx(0.02, abs=1e-3)


def test_without_an_imu_nothing_is_said(made):
  log = made()
  bare = MODEL[: MODEL.index("<sensor>")] + "</mujoco>"
  assert inertial.find(mujoco.MjModel.from_xml_string(bare), [log]) is None


@pytest.mark.parametrize(
  "seeds", [range(2), pytest.param(range(40, 80), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_healthy_imus_are_not_accused(seeds):
  """Machines of `imu_machines`: at most 1 of 20, and no alternatives either for most."""
  accused = listed = 0
  for seed in seeds:
    machine = imu_machines.draw(np.random.default_rng([seed, 3]))
    logs = [
      imu_machines.log(machine, kind, 1000 * seed + i, seed)
      for i, kind in enumerate(("sweep", "slow", "steps"))
    ]
    found = inertial.find(mujoco.MjModel.from_xml_string(machine.xml()), logs)
    accused += bool(found.effects)
    listed += bool(found.alternatives)
  assert accused <= len(seeds) // 20
  assert listed <= max(1, len(seeds) // 10)


def test_an_imu_s_own_bias_is_the_reference_s_too_and_gravity_that_turned_is_no_tilt(made):
  model = mujoco.MjModel.from_xml_string(MODEL)
  own = {"bias": (0.02, 0, -0.01, 0, 0, 0)}
  before = [made(seed=5, **own)]
  now = [made(seed=6, **own)]
  found = sensing.find(model, now, before).parts["imu"]
  assert found.rows == [] and [r["kind"] for r in found.in_reference] == ["imu_bias"]
  later = [made(seed=7, bias=(0.02, 0, 0.03, 0, 0, 0))]
  (row,) = sensing.find(model, later, before).parts["imu"].rows
  assert row["kind"] == "imu_bias"
  leaning = sensing._leaning(model, {"x": 0.05, "y": 0.0})
  np.testing.assert_allclose(leaning.opt.gravity, [0, 9.81 * np.sin(0.05), -9.81 * np.cos(0.05)])
  np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])
