"""Episode draws: ranges and switches; writing them to a compiled model, and back."""

import copy
import dataclasses

import mujoco
import numpy as np
import pytest

from nerf2real.suite.randomisation import draws as randomisation
from nerf2real.suite.randomisation import inertia

_MODEL = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -3"/>
    <body name="torso" pos="0 0 1">
      <freejoint/>
      <geom type="box" size=".05 .06 .07" pos=".01 0 .03" mass="1.3" contype="0" conaffinity="0"/>
      <site name="imu" pos="-.01 0 .05"/>
      {extra}
      <body name="arm" pos="0 .1 .1">
        <joint name="arm" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 .1 -.1" size=".02" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="ball" pos="1 0 {height}">
      <freejoint/>
      <geom name="ball" size="{radius}" mass="{mass}"/>
    </body>
  </worldbody>
  <sensor><gyro site="imu"/><accelerometer site="imu"/></sensor>
</mujoco>
"""


def _compile(extra="", radius=0.12, mass=0.651, height=-2.85):
  xml = _MODEL.format(extra=extra, radius=radius, mass=mass, height=height)
  return mujoco.MjModel.from_xml_string(xml)


def _arrays(model):
  names = [n for n in dir(model) if isinstance(getattr(model, n), np.ndarray)]
  return {n: getattr(model, n).copy() for n in names}


def _randomiser(model):
  return randomisation.Randomiser(model, torso="torso", imu_sites=("imu",), ball="ball")


@pytest.fixture(scope="module")
def episodes():
  settings, rng = randomisation.RandomisationSettings(), np.random.default_rng(0)
  return [randomisation.draw_episode(settings, rng) for _ in range(2000)]


@pytest.mark.parametrize(
  ("wrong", "message"),
  [
    ({"delay_range": (10, 50)}, "at most 0.45 s: give both in seconds"),
    ({"delay_range": (0.05, 0.01)}, "delay_range.*the smaller first"),
    ({"push_interval": (0.0, 5.0)}, "push_interval.*above 0"),
    ({"ball_radius_range": (0.0, 0.1)}, "ball_radius_range.*above 0"),
    ({"push_force": (5.0, np.inf)}, "push_force.*finite"),
    ({"max_torso_mass": -0.5}, "max_torso_mass must be 0 or more, found -0.5"),
    ({"jitter_half_width": np.nan}, "jitter_half_width must be 0 or more"),
  ],
)
def test_impossible_ranges_are_refused(wrong, message):
  with pytest.raises(ValueError, match=message):
    randomisation.RandomisationSettings(**wrong)


def test_ranges_of_the_paper(episodes):
  def column(name):
    return np.array([getattr(e, name) for e in episodes])

  for name, low, high in [
    ("imu_delay", 0.01, 0.05),
    ("joint_delay", 0.01, 0.05),
    ("camera_delay", 0.01, 0.05),
    ("torso_mass", 0.0, 0.5),
    ("ball_mass", 0.5, 0.9),
    ("ball_radius", 0.115, 0.125),
  ]:
    values = column(name)
    assert low <= values.min() < low + 0.02 * (high - low)
    assert high - 0.02 * (high - low) < values.max() <= high
    assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
  shift = np.linalg.norm(column("imu_shift"), axis=1)
  assert 0.0049 < shift.max() <= 0.005
  tilt = np.rad2deg(np.linalg.norm(column("imu_tilt"), axis=1))
  assert 1.98 < tilt.max() <= 2.0 and tilt.mean() == pytest.approx(1.0, abs=0.05)
  assert np.abs(column("imu_shift").mean(0)).max() < 2e-4
  assert {e.jitter for e in episodes} == {0.005}


def test_pushes(episodes):
  pushes = episodes[0].pushes
  gaps = np.diff(np.concatenate([[0.0], pushes.start]))
  assert (gaps >= 2.0).all() and (gaps <= 5.0).all() and pushes.start[-1] < 60.0
  strength = np.linalg.norm(pushes.force, axis=1)
  assert (strength >= 5.0).all() and (strength <= 15.0).all()
  start, duration = pushes.start[1], pushes.duration[1]
  np.testing.assert_array_equal(pushes.at(start)[:2], pushes.force[1])
  np.testing.assert_array_equal(pushes.at(start + duration - 1e-6)[:2], pushes.force[1])
  assert not pushes.at(start + duration).any() and not pushes.at(start - 1e-6).any()


def test_switches_leave_the_other_draws_alone():
  on = randomisation.draw_episode(
    randomisation.RandomisationSettings(), np.random.default_rng(5)
  )._asdict()
  touched = {
    "pushes": {"pushes"},
    "delays": {"imu_delay", "joint_delay", "camera_delay"},
    "jitter": {"jitter"},
    "torso_mass": {"torso_mass", "torso_mass_position"},
    "imu_pose": {"imu_shift", "imu_tilt"},
    "ball_mass": {"ball_mass"},
    "ball_radius": {"ball_radius"},
  }
  booleans = [f.name for f in dataclasses.fields(randomisation.RandomisationSettings)][:7]
  assert set(booleans) == set(touched)
  for switch, changed in touched.items():
    settings = randomisation.RandomisationSettings(**{switch: False})
    off = randomisation.draw_episode(settings, np.random.default_rng(5))._asdict()
    assert off.pop("light") is on["light"]
    for name, value in on.items():
      if name == "light":
        continue
      same = (
        all(
          np.array_equal(a, b)
          for a, b in zip(np.atleast_1d(value), np.atleast_1d(off[name]), strict=True)
        )
        if name != "pushes"
        else len(off[name].start) > 0
      )
      assert same == (name not in changed), (switch, name)


def test_all_off_is_nominal():
  settings = randomisation.RandomisationSettings(*[False] * 7)
  draws = randomisation.draw_episode(settings, np.random.default_rng(0))
  assert draws.vector().shape == (randomisation.NUM_DRAWS,)
  np.testing.assert_array_equal(draws.vector(), [0.0] * 14 + [0.651, 0.12])
  model = _compile()
  before = _arrays(model)
  _randomiser(model).apply(draws)
  # Body inertias are recomputed for a nominal ball: equal to rounding.
  for name, value in _arrays(model).items():
    np.testing.assert_allclose(value, before[name], rtol=1e-12, err_msg=name)


def test_apply_equals_recompilation_and_restores_bit_for_bit(episodes):
  draws = episodes[1]
  model = _compile()
  before, extent = _arrays(model), model.stat.extent
  randomiser = _randomiser(model)
  randomiser.apply(draws)
  position = " ".join(f"{x:.17g}" for x in draws.torso_mass_position)
  # A small sphere stands for the point mass: its own inertia, 1e-7 kg m^2, is negligible.
  geom = (
    f'<geom size="1e-3" pos="{position}" mass="{draws.torso_mass:.17g}" contype="0"'
    ' conaffinity="0"/>'
  )
  fresh = _compile(geom, draws.ball_radius, draws.ball_mass)
  shift = draws.imu_shift + np.array([-0.01, 0, 0.05])
  data, expected = mujoco.MjData(model), mujoco.MjData(fresh)
  fresh.site_pos[0], fresh.site_quat[0] = shift, model.site_quat[0]
  fresh.site_sameframe[0] = 0
  for d in (data, expected):
    d.qvel[:] = 0.5
  for _ in range(200):
    mujoco.mj_step(model, data)
    mujoco.mj_step(fresh, expected)
  np.testing.assert_allclose(data.qpos, expected.qpos, atol=2e-6)
  np.testing.assert_allclose(data.sensordata, expected.sensordata, rtol=1e-4, atol=1e-4)
  np.testing.assert_allclose(model.body_subtreemass, fresh.body_subtreemass)
  assert model.stat.extent == extent
  # The tilt of the IMU has the angle drawn.
  quat = model.site_quat[0]
  assert 2 * np.arccos(min(1.0, quat[0])) == pytest.approx(np.linalg.norm(draws.imu_tilt), rel=1e-6)
  randomiser.apply(episodes[2])
  randomiser.restore()
  for name, value in _arrays(model).items():
    np.testing.assert_array_equal(value, before[name], err_msg=name)


def test_ball_rests_at_its_radius(episodes):
  model = _compile(height=-2.87)
  draws = max(episodes[:50], key=lambda e: e.ball_radius)
  _randomiser(model).apply(draws)
  data = mujoco.MjData(model)
  for _ in range(1500):
    mujoco.mj_step(model, data)
  height = data.body("ball").xpos[2] + 3
  assert height == pytest.approx(draws.ball_radius, abs=1e-3)


def test_simple_bodies():
  xml = """<mujoco><worldbody>
    <body><joint name="cart" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body>
    <body><joint name="spin" axis="0 1 0"/><geom size=".1" mass="2"/></body>
  </worldbody></mujoco>"""
  model = mujoco.MjModel.from_xml_string(xml)
  scratch = mujoco.MjData(model)
  inertia.attach_mass(model, 1, added=0.5, position=(0.1, 0, 0))
  inertia.refresh(model, scratch)
  assert model.dof_M0[0] == pytest.approx(2.5)
  with pytest.raises(ValueError, match="simple"):
    inertia.attach_mass(model, 2, added=0.5, position=(0.1, 0, 0))


def test_combined_inertia_by_hand():
  # 2 kg with inertia 0.1 at the origin, 1 kg at (0.3, 0, 0): centre at 0.1, reduced mass 2/3 kg,
  # so 0.1 + 2/3 * 0.09 = 0.16 about y and z, and 0.1 about x.
  mass, centre, matrix = inertia.combine_point_mass(
    2.0, np.zeros(3), 0.1 * np.eye(3), added=1.0, position=np.array([0.3, 0.0, 0.0])
  )
  assert mass == 3.0
  np.testing.assert_allclose(centre, [0.1, 0, 0])
  np.testing.assert_allclose(matrix, np.diag([0.1, 0.16, 0.16]))


def test_unknown_names():
  model = copy.copy(_compile())
  with pytest.raises(ValueError, match=r"no body named 'head'.*torso"):
    randomisation.Randomiser(model, torso="head")
  with pytest.raises(ValueError, match="no site"):
    randomisation.Randomiser(model, imu_sites=("nose",))
