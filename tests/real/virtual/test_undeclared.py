"""Undeclared effects by name, and that the virtual robot does what is hidden in it."""

import dataclasses

import numpy as np
import pytest

from nerf2real.real.clock import SteppedClock
from nerf2real.real.virtual import undeclared
from nerf2real.real.virtual.body import Body
from nerf2real.real.virtual.camera import LENS, SteppedCamera, VirtualCamera
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.motors import Motors
from nerf2real.suite.effects import KINDS as LIBRARY
from nerf2real.suite.op3 import constants
from tests.real.virtual.standing import stand

KNEE = constants.JOINT_NAMES.index("l_knee")


def _build(*texts, seed=None):
  return undeclared.build(seed, undeclared.parse_all(texts))


def _motors(*texts):
  motors = Motors(_build(*texts).hidden.motors)
  motors.enabled[:] = True
  motors.measure(np.zeros(20), np.zeros(20))
  return motors


def test_what_is_parsed_is_written_again():
  for text in ("command_delay:0.045", "motor_gain@l_knee:0.6", "floor_slope:0.01,-0.02"):
    (effect,) = undeclared.parse(text)
    assert str(effect) == text
  (load,) = undeclared.parse("payload@l_el_link:0.25")
  assert load.parameters == {"mass": 0.25, "x": 0.0, "y": 0.0, "z": 0.0}
  assert [effect.kind for effect in undeclared.parse("other_camera")] == [
    "camera_latency",
    "camera_focal",
  ]
  assert undeclared.parse("nothing") == []


def test_a_file_holds_an_effect_a_line(tmp_path):
  path = tmp_path / "hidden.txt"
  path.write_text("# two\ncommand_delay:0.03\n\nweak_knee  # a case\n")
  assert [str(e) for e in undeclared.parse(str(path))] == [
    "command_delay:0.03",
    "motor_gain@l_knee:0.6",
  ]


@pytest.mark.parametrize(
  "text, said",
  [
    ("comand_delay:0.1", "Unknown undeclared effect 'comand_delay': expected one of 'nothing'"),
    ("command_delay", "expected the numbers delay"),
    ("command_delay:soon", "Found 'soon' for command_delay"),
    ("command_delay@l_knee:0.1", "expected no target"),
    ("motor_gain@l_kne:0.1", "expected one of head_pan"),
    ("payload:0.2", "Found the target None of payload"),
    ("command_delay:-1", "Found -1 for delay of command_delay, expected 0 or more"),
    ("floor_slope:0,nan", "Found nan for y of floor_slope, expected a finite number"),
  ],
)
def test_what_is_no_effect_is_one_clear_line(text, said):
  with pytest.raises(ValueError, match=said) as found:
    undeclared.parse(text)
  assert "\n" not in str(found.value)


def test_names_and_parameters_are_the_librarys():
  for name, kind in undeclared.KINDS.items():
    assert (name in LIBRARY) == kind.in_library
    if kind.in_library:
      assert set(kind.parameters) <= {p.name for p in LIBRARY[name].parameters}


def test_a_size_is_scaled_from_none():
  (delay,), (focal,) = undeclared.parse("command_delay:0.02"), undeclared.parse("camera_focal:1.1")
  assert delay.scaled(2.0).values == (0.04,)
  assert focal.scaled(2.0).values == (pytest.approx(1.2),)
  (course,) = undeclared.parse("supply_course:2.0,12.4,600")
  assert course.scaled(0.5).values == (1.0, 12.4, 600.0)


def test_a_seed_draws_the_same_and_seeds_differ():
  drawn = [undeclared.draw(seed) for seed in range(12)]
  assert drawn == [undeclared.draw(seed) for seed in range(12)]
  assert len({effects[0].kind for effects in drawn}) >= 3
  assert all(effects for effects in drawn)


def test_nothing_hidden_is_the_same_robot():
  build = _build("nothing", seed=3)
  assert dataclasses.replace(build.hidden, motors=None) == dataclasses.replace(
    Hidden.draw(3), motors=None
  )
  np.testing.assert_array_equal(build.hidden.motors.strength, Hidden.draw(3).motors.strength)
  assert build.camera == VirtualCamera()


def test_late_commands_act_late():
  motors = _motors("late_commands")
  motors.set_goal(KNEE, 2148, 1.0)
  assert motors.torque(1.044, 0.001)[0][KNEE] == 0.0
  assert motors.torque(1.0451, 0.001)[0][KNEE] > 0.5


def test_a_delay_adds_to_the_robots_own():
  own = Hidden.draw(3).motors.goal_delay
  assert _build("late_commands", seed=3).hidden.motors.goal_delay == pytest.approx(own + 0.045)


def test_a_weak_knee_has_its_share_of_the_torque():
  weak, healthy = _motors("weak_knee"), _motors()
  for motors in (weak, healthy):
    for index in range(20):
      motors.set_goal(index, 2100, 0.0)
  ratio = weak.torque(0.0, 0.001)[0] / healthy.torque(0.0, 0.001)[0]
  expected = np.ones(20)
  expected[KNEE] = 0.6
  np.testing.assert_allclose(ratio, expected, rtol=1e-9)


def test_a_gear_under_load_and_slippery_feet():
  own = Hidden.draw(3)
  build = _build("load_friction@l_knee:0.3", "floor_friction:0.25", seed=3).hidden
  added = np.zeros(20)
  added[KNEE] = 0.3
  np.testing.assert_allclose(build.motors.gear_share, own.motors.gear_share + added)
  assert build.foot_friction == pytest.approx(0.25 * own.foot_friction)


def test_a_load_hangs_on_the_forearm():
  build = _build("payload@l_el_link:0.25,0,0.05,0")
  model, healthy = Body(hidden=build.hidden).model, Body().model
  assert model.body_mass.sum() - healthy.body_mass.sum() == pytest.approx(0.25)
  load = model.body("op3/load_1")
  assert model.body(load.parentid[0]).name == "op3/l_el_link"
  np.testing.assert_allclose(load.pos, [0, 0.05, 0])


def test_on_a_sloping_floor_a_standing_robot_feels_gravity_aslant():
  slope = 0.05  # about y: the floor falls towards +x
  body = Body(hidden=_build(f"floor_slope:0,{slope}").hidden)
  stand(body, 0.3)
  body.hold(False)
  stand(body, 2.5)
  truth = body.truth()
  assert truth.rotation[2, 2] > 0.999  # it stands on the floor, not along gravity
  felt = truth.rotation @ body.imu[3:]
  # The floor is turned by R from level: felt = R^T (0, 0, 1) = (-sin, 0, cos).
  np.testing.assert_allclose(felt / 9.81, [-np.sin(slope), 0.0, np.cos(slope)], atol=0.01)


def test_a_supply_sags_through_the_session():
  hidden = _build("supply_course:2.3,12.5,1200").hidden
  volts = {}
  for age in (0.0, 600.0, 1200.0, 5000.0):
    motors = Motors(dataclasses.replace(hidden.motors, battery_resistance=0.0, battery_age=age))
    motors.measure(np.zeros(20), np.zeros(20))
    motors.torque(77.0, 0.001)  # the clock's zero is not the battery's
    volts[age] = motors.supply
  assert volts == pytest.approx({0.0: 12.5, 600.0: 11.35, 1200.0: 10.2, 5000.0: 10.2})
  motors.torque(77.0 + 10.0, 0.001)
  fresh = Motors(dataclasses.replace(hidden.motors, battery_resistance=0.0))
  for time in (5.0, 605.0):
    fresh.torque(time, 0.001)
  assert fresh.supply == pytest.approx(11.35)


def test_friction_grows_at_rest_and_goes_with_motion():
  motors, healthy = _motors("rest_friction:0.4,0.2"), _motors()
  usual = healthy.torque(0.0, 0.001)[1][KNEE]
  grown = []
  for _ in range(1000):
    grown.append(motors.torque(0.0, 0.001)[1][KNEE] - usual)
  assert grown[0] < 0.01 and grown[199] == pytest.approx(0.4 * (1 - np.exp(-1)), abs=0.01)
  assert grown[-1] == pytest.approx(0.4 * (1 - np.exp(-5)), abs=0.01)
  speed = np.zeros(20)
  speed[KNEE] = 0.5
  motors.measure(np.zeros(20), speed)
  _, friction = motors.torque(0.0, 0.001)
  # Torque of the moving joint is the healthy one's, and so is what the gear takes of it.
  healthy.measure(np.zeros(20), speed)
  assert friction[KNEE] == pytest.approx(healthy.torque(0.0, 0.001)[1][KNEE])
  assert friction[0] > 0.3  # the others still rest


def test_a_late_camera_shows_the_past_and_its_driver_does_not_know():
  seen, ages = {}, {}

  class Eyes:
    def picture(self, time):
      seen[name] = time
      return np.zeros((2, 2, 3), np.uint8)

  clock = SteppedClock()
  clock.advance(clock.now() + 2.0)
  for name in ("nothing", "other_camera"):
    settings = _build(name).camera
    ages[name] = SteppedCamera(Eyes(), clock, settings, seed=0).read()[1]
  assert seen["nothing"] - seen["other_camera"] == pytest.approx(0.12, abs=1 / 30)
  assert clock.now() - seen["nothing"] == pytest.approx(ages["nothing"])
  assert clock.now() - seen["other_camera"] == pytest.approx(ages["other_camera"] + 0.12)
  lens = _build("other_camera").camera.lens
  assert (lens.fx, lens.fy) == pytest.approx((1.12 * LENS.fx, 1.12 * LENS.fy))
  assert (lens.cx, lens.k1) == (LENS.cx, LENS.k1)
