"""The floor's slope against a biped that stands on an inclined plane, by composed rotations."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.robot_logs.reading import ImuSeries, JointSeries, Log
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.effects.files import from_list, to_list
from nerf2real.sysid.outputs import extended_model
from nerf2real.sysid.sensors import floor, standing
from nerf2real.sysid.sensors.stops import Stood

LEG = (
  '<body pos="0 {y} -0.1"><joint name="{n}_hip" axis="0 1 0"/><geom type="capsule" size=".02 .06"'
  ' pos="0 0 -.1"/><body pos="0 0 -0.2"><joint name="{n}_ankle" axis="0 1 0"/>'
  '<geom type="box" size=".06 .03 .01" pos="0.01 0 -.03"/></body></body>'
)
MODEL = (
  '<mujoco><worldbody><geom name="ground" type="plane" size="2 2 .1"/>'
  '<body pos="0 0 .4"><freejoint/>'
  '<geom type="box" size=".06 .08 .1" mass="2"/><site name="imu" euler="0 0 90"/>'
  + LEG.format(y="0.05", n="l")
  + LEG.format(y="-0.05", n="r")
  + "</body></worldbody><actuator>"
  + "".join(f'<position joint="{s}_{p}" kp="20"/>' for s in "lr" for p in ("hip", "ankle"))
  + '</actuator><sensor><gyro site="imu"/><accelerometer site="imu"/></sensor></mujoco>'
)
NAMES = ("l_hip", "l_ankle", "r_hip", "r_ankle")
IMU = Rotation.from_euler("z", 90, degrees=True)  # torso from the IMU's site


def _log(
  headings, *, slope=(0.0, 0.0), tilt=(0.0, 0.0, 0.0), lean=0.05, bias=(0.0, 0.0, 0.0), seed=0
) -> Log:
  """Returns a robot that stands 1.5 s at every heading [rad] and turns for 1 s between them."""
  rng = np.random.default_rng([seed, 41])
  time = np.arange(0, 2.5 * len(headings), 0.008)
  phase, leg = np.divmod(time, 2.5)
  phase = phase.astype(int)
  share = np.clip(leg - 1.5, 0, 1)
  following = np.append(headings[1:], headings[-1])
  heading = np.asarray(headings)[phase] + share * (following - np.asarray(headings))[phase]
  walking = np.where(share > 0, np.sin(np.pi * share), 0.0)  # legs move while it turns
  hip = 0.3 + 0.2 * walking * np.sin(20 * time)
  ankle = -hip + lean  # the torso leans by -lean against the soles
  ground = Rotation.from_rotvec([*slope, 0.0])
  torso = (
    ground
    * Rotation.from_rotvec(heading[:, None] * [0.0, 0, 1])
    * Rotation.from_rotvec([0, -lean, 0])
  )
  mounted = IMU * Rotation.from_rotvec(tilt)
  rate = (torso[:-1].inv() * torso[1:]).as_rotvec() / 0.008
  rate = mounted.inv().apply(np.vstack([rate, rate[-1:]]))
  force = (torso * mounted).inv().apply([0, 0, 9.81]) + bias
  rate = rate + np.array([0.004, -0.006, 0.008]) + rng.normal(0, 0.003, rate.shape)
  force = (
    force + rng.normal(0, 0.05, force.shape) + 0.4 * walking[:, None] * rng.normal(size=force.shape)
  )
  joints = np.stack([hip, ankle, hip, ankle], axis=1)
  joints = np.round((joints + rng.normal(0, 2e-4, joints.shape)) / 0.001534) * 0.001534
  states = JointSeries(NAMES, time, time, joints, None, None)
  return Log(
    name="a.mcap",
    start_ns=0,
    commands=states,
    states=states,
    pwm=None,
    imu=ImuSeries(time, time, rate, force, "imu"),
    battery=None,
    temperatures={},
  )


def _find(*logs, known=None):
  return floor.find(mujoco.MjModel.from_xml_string(MODEL), list(logs), known)


TURNS = (0.0, 1.3, 2.6, 4.0)


@pytest.mark.parametrize("slope", [(0.06, 0.0), (0.0, -0.05), (-0.04, 0.05)])
def test_a_robot_that_turns_finds_the_slope(slope):
  part = _find(_log(TURNS, slope=slope))
  assert [r["kind"] for r in part.rows] == ["floor_slope"]
  assert part.rows[0]["geom"] == "ground"
  for axis, true in zip("xy", slope, strict=True):
    found = part.rows[0]["parameters"][axis]
    assert found["value"] == pytest.approx(true, abs=0.004)
    assert found["low"] < true < found["high"]
  (effect,) = from_list(to_list(part.effects))
  assert effect.target == "ground"
  # The suite's own operator turns its floor by as much.
  model = mujoco.MjModel.from_xml_string(MODEL)
  EffectStack([effect]).bind(model)
  up = Rotation.from_quat(model.geom("ground").quat, scalar_first=True).apply([0, 0, 1.0])
  assert up == pytest.approx(Rotation.from_rotvec([*slope, 0]).apply([0, 0, 1.0]), abs=0.006)


def test_a_tilted_imu_is_not_the_floor():
  part = _find(_log(TURNS, tilt=(0.05, 0.03, 0.0)))
  assert part.rows == []


def test_a_slope_is_found_beside_a_tilted_imu():
  part = _find(_log(TURNS, slope=(0.05, 0.02), tilt=(0.04, 0.0, 0.0)))
  assert [r["kind"] for r in part.rows] == ["floor_slope"]
  assert part.rows[0]["parameters"]["x"]["value"] == pytest.approx(0.05, abs=0.004)


def test_facing_one_way_slope_tilt_and_bias_are_alternatives():
  part = _find(_log((0.0, 0.05, 0.0, 0.03), slope=(0.06, 0.0)))
  assert part.rows == []
  kinds = {a["kind"]: a["parameters"] for a in part.alternatives}
  assert set(kinds) == {"floor_slope", "imu_tilt", "imu_bias"}
  assert kinds["floor_slope"]["x"]["value"] == pytest.approx(0.06, abs=0.005)


def test_what_looks_like_a_slope_is_listed_with_the_size_that_would_look_so():
  tilted = _find(_log((0.0,), tilt=(0.05, 0.0, 0.0)))
  biased = _find(_log((0.0,), bias=(0.5, 0.0, 0.0)))
  found = {a["kind"]: a["parameters"] for a in tilted.alternatives}
  assert found["imu_tilt"]["x"]["value"] == pytest.approx(0.05, abs=0.005)
  found = {a["kind"]: a["parameters"] for a in biased.alternatives}
  assert found["imu_bias"]["accelerometer_x"]["value"] == pytest.approx(0.5, abs=0.04)


def test_a_level_floor_is_not_accused():
  for seed in range(20):
    rng = np.random.default_rng([seed, 42])
    tilt = rng.normal(0, 0.01 / 3, 3)
    lean = rng.uniform(-0.1, 0.1)
    part = _find(_log(np.sort(rng.uniform(0, 6, 4)), tilt=tilt, lean=lean, seed=seed))
    assert part.rows == [] and part.alternatives == [], seed


def test_a_robot_held_in_the_air_is_not_believed():
  """Whoever holds it lets it lean otherwise at every stop."""
  logs = [
    _log((h,), slope=tuple(np.random.default_rng([7, i]).normal(0, 0.05, 2)), seed=i)
    for i, h in enumerate(TURNS)
  ]
  assert _find(*logs, known=[[Stood(0.0, 1.5, h)] for h in TURNS]).rows == []


def test_known_headings_give_the_slope_in_the_worlds_axes():
  """Nothing shows how the robot was carried from stop to stop, and the first faces 1.1 rad."""
  slope = (0.03, -0.05)
  headings = [1.1 + turn for turn in TURNS]
  logs = [_log((h,), slope=slope, lean=0.07, seed=i) for i, h in enumerate(headings)]
  (found,) = _find(*logs, known=[[Stood(0.0, 1.5, h)] for h in headings]).rows
  for axis, value in zip("xy", slope, strict=True):
    parameter = found["parameters"][axis]
    assert parameter["low"] <= value <= parameter["high"]
    assert parameter["high"] - parameter["low"] < 0.015
  assert all(_find(log).rows == [] for log in logs)  # one stop shows none


def test_the_sole_is_what_a_robot_stands_on():
  model = mujoco.MjModel.from_xml_string(MODEL)
  data = mujoco.MjData(model)
  data.qpos[7:] = [0.4, -0.3, 0.4, -0.3]  # the soles pitch by 0.1 in the torso's frame
  data.qpos[3:7] = [1, 0, 0, 0]
  mujoco.mj_kinematics(model, data)
  mujoco.mj_comPos(model, data)
  found = standing.normal(model, data, 1, np.array([0.0, 0, 1]))
  assert found == pytest.approx(Rotation.from_euler("y", 0.1).apply([0, 0, 1.0]), abs=1e-6)


def test_without_a_floor_or_a_free_body_nothing_is_said():
  log = _log((0.0,))
  for xml in (
    MODEL.replace('<geom name="ground" type="plane" size="2 2 .1"/>', ""),
    MODEL.replace("<freejoint/>", ""),
  ):
    assert floor.find(mujoco.MjModel.from_xml_string(xml), [log]) is None


def test_the_extended_model_has_the_slope(tmp_path):
  effect = Effect("floor_slope", "ground", {"x": 0.05, "y": -0.03})
  xml = MODEL.replace('type="plane"', 'type="plane" euler="3 0 20"')
  (tmp_path / "model.xml").write_text(xml)
  assert extended_model.write(tmp_path / "model.xml", tmp_path / "out.xml", [effect]) == []
  model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
  expected = mujoco.MjModel.from_xml_string(xml)
  EffectStack([effect]).bind(expected)
  assert model.geom("ground").quat == pytest.approx(expected.geom("ground").quat, abs=1e-5)
