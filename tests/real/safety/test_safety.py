"""Every reason to switch the torque off, on the virtual bus."""

import numpy as np
import pytest

from nerf2real.real.safety.monitor import Limiter, Reason, SafetyError
from nerf2real.real.virtual.bus.devices import IDS
from nerf2real.suite.op3 import constants

_PAN = constants.JOINT_NAMES.index("head_pan")


def _run(environment, steps, action=None):
  """Steps until an episode ends; returns the last time step."""
  timestep = None
  for _ in range(steps):
    timestep = environment.step(environment.standing_action if action is None else action)
    if timestep.last():
      break
  return timestep


def _stopped(environment, robot, reason, within):
  """Steps until the stop; checks its reason, how soon it came, and that the torque is off."""
  start = robot.clock.now()
  timestep = _run(environment, round(within / 0.025) + 2)
  assert timestep.last() and timestep.discount == 0.0
  assert environment.stop.reason == reason, environment.stop
  assert environment.stop.time - start <= within + 0.009, environment.stop
  robot.clock.sleep_until(robot.clock.now() + 0.05)
  robot.truth()
  assert not robot.body.motors.enabled.any()
  return environment.stop


@pytest.fixture
def standing(load):
  environment = load()
  environment.reset()
  _run(environment, 4)
  return environment


def test_a_fall(robot, standing):
  robot.push(np.array([0.0, 60.0, 0.0]))
  stop = _stopped(standing, robot, Reason.FALL, 1.5)
  assert "degrees" in stop.detail
  assert robot.body.truth().rotation[2, 2] < 0.75  # when it was judged, the filter's delay later


def test_a_hot_servo(robot, standing):
  robot.faults.heat[IDS["l_knee"]] = 72.0  # the servo itself would go on to 80
  assert "l_knee: 72" in _stopped(standing, robot, Reason.TEMPERATURE, 0.05).detail


def test_a_servos_own_error(robot, standing):
  robot.faults.heat[IDS["l_knee"]] = 82.0
  assert "l_knee" in _stopped(standing, robot, Reason.SERVO, 0.05).detail


def test_a_low_battery(robot, standing):
  robot.faults.voltage = 9.8
  assert "9.8 V" in _stopped(standing, robot, Reason.VOLTAGE, 0.25).detail


def test_a_short_dip_is_no_low_battery(robot, standing):
  robot.faults.voltage = 9.8
  _run(standing, 4)
  robot.faults.voltage = None
  assert not _run(standing, 20).last()


def test_a_brown_out(robot, standing):
  """The servos reset: they do not answer, and come back without torque."""
  robot.faults.voltage = 5.0
  _stopped(standing, robot, Reason.BUS, 0.13)
  robot.faults.voltage = None


@pytest.mark.parametrize("fault", ["cut", "dead"])
def test_a_lost_bus(robot, standing, fault):
  if fault == "cut":
    robot.faults.cut = True
  else:
    robot.faults.dead.add(IDS["r_knee"])
  start = robot.clock.now()
  timestep = _run(standing, 10)
  assert timestep.last() and standing.stop.reason == Reason.BUS
  assert 0.09 < standing.stop.time - start < 0.125  # from the last reading
  if fault == "cut":  # the servos' own watchdogs have frozen them
    _, motors = robot.truth(), robot.body.motors
    assert motors.enabled.all()
    assert {s.table["bus_watchdog"] for s in robot.devices.servos.values()} == {-1}
    robot.faults.cut = False
  robot.clock.sleep_until(robot.clock.now() + 0.3)
  robot.truth()
  assert not robot.body.motors.enabled.any()  # switched off as soon as the bus is back


def test_a_servo_that_dies_is_named_when_the_robot_is_started_again(robot, standing):
  robot.faults.dead.add(IDS["r_knee"])
  _run(standing, 10)
  with pytest.raises(SafetyError, match=r"13 \(r_knee\)"):
    standing.reset()


def test_a_lost_camera(robot, load, picture):
  environment = load(pictures=picture)
  environment.reset()
  picture.follows = False
  stop = _stopped(environment, robot, Reason.CAMERA, 0.55)
  assert "0.5" in stop.detail


def test_a_camera_that_raises(robot, load, picture):
  environment = load(pictures=picture)
  environment.reset()
  picture.error = OSError("unplugged")
  _stopped(environment, robot, Reason.CAMERA, 0.55)


def test_a_picture_that_comes_a_little_late_is_no_lost_camera(load, picture):
  environment = load(pictures=picture)
  environment.reset()
  picture.follows = False
  assert not _run(environment, 14).last()  # 0.35 s
  picture.follows = True
  assert not _run(environment, 30).last()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_no_number(robot, standing, value):
  action = standing.standing_action
  action[3] = value
  timestep = standing.step(action)
  assert timestep.last() and standing.stop.reason == Reason.ACTION
  assert all(np.isfinite(found).all() for found in timestep.observation.values())
  robot.clock.sleep_until(robot.clock.now() + 0.02)
  robot.truth()
  assert not robot.body.motors.enabled.any()


def test_the_operators_key(robot, standing):
  robot.operator.press()
  _stopped(standing, robot, Reason.OPERATOR, 0.03)


def test_the_operators_key_stops_the_slow_move_too(robot, load):
  environment = load()
  robot.body.data.qpos[robot.body._qpos[_PAN]] = 0.8
  after = robot.body.after_step

  def press(time):
    after(time)
    if robot.body.motors.enabled.all():
      robot.operator.press()

  robot.body.after_step = press
  with pytest.raises(SafetyError, match="operator"):
    environment.reset()
  robot.body.after_step = after
  robot.clock.sleep_until(robot.clock.now() + 0.05)
  robot.truth()
  assert not robot.body.motors.enabled.any()


def test_the_operators_key_stops_while_the_joints_come_to_rest(robot, load, monkeypatch):
  """The torque is off then; it must stay off, and the key must not wait for the joints."""
  environment = load()
  resting = environment.servos._resting_counts

  def press_and_wait():
    robot.operator.press()
    return resting()

  monkeypatch.setattr(environment.servos, "_resting_counts", press_and_wait)
  enabled = []
  after = robot.body.after_step
  robot.body.after_step = lambda time: (
    after(time),
    enabled.append(robot.body.motors.enabled.any()),
  )
  with pytest.raises(SafetyError, match="operator"):
    environment.reset()
  robot.clock.sleep_until(robot.clock.now() + 0.05)
  robot.truth()
  assert enabled and not any(enabled)


def test_a_stuck_encoder(robot, standing):
  robot.faults.stuck.add(IDS["head_pan"])
  action = standing.standing_action
  action[_PAN] = 1.0
  timestep = _run(standing, 80, action)
  assert timestep.last() and standing.stop.reason == Reason.TRACKING
  assert standing.stop.detail == "head_pan"


def test_an_error_in_the_cycle_itself(robot, standing, monkeypatch):
  def broken(*_):
    raise ZeroDivisionError("a bug")

  monkeypatch.setattr(standing._cycle.sensing, "take_imu", broken)
  stop = _stopped(standing, robot, Reason.FAILURE, 0.03)
  assert "a bug" in stop.detail


def test_after_a_stop_no_goal_is_sent(robot, standing):
  robot.operator.press()
  _run(standing, 4)
  goals = robot.body.motors.goal.copy()
  assert not standing._cycle.send(np.zeros(20))
  robot.clock.sleep_until(robot.clock.now() + 0.05)
  np.testing.assert_array_equal(robot.body.motors.goal, goals)


def test_the_robot_can_be_started_again_when_the_cause_is_gone(robot, standing):
  robot.push(np.array([0.0, 60.0, 0.0]))
  _run(standing, 80)
  assert standing.stop is not None
  robot.push(np.zeros(3))
  robot.place(0.0, 0.0, 0.0)
  assert standing.reset().first() and standing.stop is None
  assert not _run(standing, 20).last()


def test_the_robot_can_be_started_again_after_a_lost_bus(robot, standing):
  """The servos' watchdogs have run out: until they are cleared no goal is taken."""
  robot.faults.cut = True
  _run(standing, 10)
  robot.faults.cut = False
  robot.clock.sleep_until(robot.clock.now() + 0.3)
  assert {s.table["bus_watchdog"] for s in robot.devices.servos.values()} == {-1}
  robot.place(0.0, 0.0, 0.0)
  assert standing.reset().first() and standing.stop is None
  assert {s.table["bus_watchdog"] for s in robot.devices.servos.values()} == {5}


def test_a_fallen_robot_may_lie_until_a_person_has_come(robot, standing):
  robot.push(np.array([0.0, 60.0, 0.0]))
  _run(standing, 80)
  robot.push(np.zeros(3))
  hold = robot.operator._hold

  def come(held):
    if held:
      robot.clock.sleep_until(robot.clock.now() + 0.3)
      assert robot.truth().rotation[2, 2] < 0.5
      robot.place(0.0, 0.0, 0.0)
    hold(held)

  robot.operator._hold = come
  assert standing.reset().first() and standing.stop is None
  robot.operator._hold = hold


def test_a_servo_with_an_error_must_be_rebooted_first(robot, standing):
  device = IDS["l_knee"]
  robot.faults.heat[device] = 82.0
  _run(standing, 10)
  robot.faults.heat[device] = 30.0
  with pytest.raises(SafetyError, match=r"l_knee.*overheating"):
    standing.reset()
  standing.servos.reboot("l_knee")
  robot.place(0.0, 0.0, 0.0)
  assert standing.reset().first()


def test_goals_keep_limits_and_speed():
  lower, upper = constants.joint_limits()
  limiter = Limiter(lower, upper, max_speed=4.0)
  limiter.reset(np.zeros(20))
  goal = np.where(np.arange(20) % 2, 5.0, -5.0)
  before = limiter.goal
  for _ in range(40):
    found = limiter(goal, 0.025)
    assert np.abs(found - before).max() <= 0.1 + 1e-12
    before = found
  np.testing.assert_allclose(found, np.clip(goal, lower, upper))
