"""Tests of the voltage law against the data sheet's figures."""

import numpy as np
import pytest

from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.motors import MotorParameters, Motors


def _motors(**changes):
  import dataclasses

  values = dataclasses.replace(MotorParameters.nominal(1), battery_resistance=0.0, **changes)
  motors = Motors(values)
  motors.enabled[:] = True
  return motors


def _pull(motors, error_counts, speed=0.0):
  """Returns torque and friction when the goal is some counts away."""
  motors.measure(np.zeros(1), np.array([speed]))
  motors.set_goal(0, int(motors.counts[0]) + error_counts, 0.0)
  torque, friction = motors.torque(0.0, 0.001)
  return float(torque[0]), float(friction[0])


def test_stall_torque_and_current_are_those_of_the_data_sheet():
  motors = _motors(dry_friction=np.zeros(1))
  torque, friction = _pull(motors, 2000)
  assert torque - friction == pytest.approx(4.1, rel=1e-6)
  assert motors.current[0] == pytest.approx(2.3)
  assert motors.duty[0] == 1.0


def test_there_is_no_torque_at_the_no_load_speed():
  torque, _ = _pull(_motors(), 2000, speed=46 * 2 * np.pi / 60)
  assert torque == pytest.approx(0.0, abs=1e-9)


def test_stiffness_and_damping_lie_in_the_range_of_the_data_sheet():
  """P 800, 12 V: 18.9 N m/rad by the stall torque, 26.4 ideal; 0.85 to 1.19 N m s/rad."""
  count = 10
  angle = count * 2 * np.pi / 4096
  torque, friction = _pull(_motors(dry_friction=np.zeros(1)), count)
  assert torque / angle == pytest.approx(26.4, abs=0.1)
  assert (torque - friction) / angle == pytest.approx(18.9, abs=0.1)
  slower, _ = _pull(_motors(), 0, speed=1.0)
  assert -slower == pytest.approx(1.19, abs=0.01)


def test_duty_is_p_times_error_within_the_pwm_limit():
  motors = _motors()
  _pull(motors, 64)
  assert motors.duty[0] == pytest.approx(800 / 128 * 64 / 885)
  motors.p_gain[:] = 400
  _pull(motors, 64)
  assert motors.duty[0] == pytest.approx(400 / 128 * 64 / 885)
  motors.pwm_limit[:] = 100
  _pull(motors, -640)
  assert motors.duty[0] == pytest.approx(-100 / 885)


def test_without_torque_nothing_pulls():
  motors = _motors()
  motors.enabled[:] = False
  assert _pull(motors, 500)[0] == 0.0 and motors.current[0] == 0.0


def test_load_lowers_the_supply_and_warms_the_motor():
  motors = Motors(MotorParameters.nominal(1))
  motors.enabled[:] = True
  idle = motors.supply
  for _ in range(1000):
    _pull(motors, 2000)
  assert motors.supply < idle - 0.2
  assert motors.temperature[0] > 25.3  # 28 W for a second


def test_a_delayed_goal_acts_later():
  motors = _motors(goal_delay=0.003)
  motors.measure(np.zeros(1), np.zeros(1))
  motors.set_goal(0, 2148, 1.0)
  assert motors.torque(1.002, 0.001)[0][0] == pytest.approx(0.0, abs=1e-9)
  assert motors.torque(1.0031, 0.001)[0][0] > 0.5


def test_a_seed_draws_always_the_same_robot_and_another_another():
  first, second = Hidden.draw(1), Hidden.draw(1)
  np.testing.assert_array_equal(first.motors.strength, second.motors.strength)
  assert first.payload == second.payload != Hidden.draw(2).payload
