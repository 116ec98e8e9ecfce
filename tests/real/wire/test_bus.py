"""Tests of the bus on the virtual robot."""

import contextlib
import os
import threading
import time
import tty

import numpy as np
import pytest

from nerf2real.real.virtual.bus.devices import IDS
from nerf2real.real.wire.bus import Bus, BusError, BusSettings
from nerf2real.real.wire.port import PortError
from nerf2real.real.wire.servos import Servos
from nerf2real.suite.op3 import constants


@pytest.fixture
def bus(robot):
  found = Bus(robot.port, clock=robot.clock)
  yield found
  found.close()


@pytest.fixture
def servos(bus):
  return Servos(bus)


@pytest.fixture
def ready(bus, servos):
  servos.power_on()
  servos.set_up()
  return bus


def _wait(robot, seconds):
  robot.clock.advance(robot.clock.now() + seconds)
  robot.body.advance(robot.clock.now())


def test_a_missing_port_is_said(tmp_path):
  with pytest.raises(PortError, match="nothing_here"):
    Bus(str(tmp_path / "nothing_here"))


def test_missing_devices_are_named(robot, bus, servos):
  robot.faults.dead |= {13, 4}
  with pytest.raises(BusError, match=r"4 \(l_sho_roll\), 13 \(r_knee\)"):
    servos.power_on()
  robot.faults.cut = True
  with pytest.raises(BusError, match="OpenCR board"):
    servos.power_on()


def test_another_model_is_refused(robot, bus, servos):
  robot.devices.servos[7].table["model_number"] = 1030
  with pytest.raises(BusError, match=r"Servo 7 \(r_hip_yaw\) has model number 1030"):
    servos.power_on()


def test_set_up_writes_the_registers_of_every_servo(robot, bus, servos):
  for servo in robot.devices.servos.values():  # as somebody else left them
    servo.table["position_i_gain"], servo.table["operating_mode"] = 300, 5
    servo.table["profile_velocity"] = 50
  servos.power_on()
  servos.set_up()
  for servo in robot.devices.servos.values():
    table = servo.table
    names = ("operating_mode", "return_delay_time", "position_p_gain", "position_i_gain")
    assert [table[name] for name in names] == [3, 0, 800, 0]
    assert table["pwm_limit"] == 885 and table["profile_velocity"] == 0
    assert table["torque_enable"] == 0


def test_a_register_that_does_not_hold_is_an_error(robot, bus, servos):
  servos.power_on()
  table = robot.devices.servos[IDS["l_knee"]].table
  table.registers["position_p_gain"] = table.registers["position_p_gain"]._replace(high=700)
  table._by_address[84] = table.registers["position_p_gain"]
  with pytest.raises(BusError, match=r"l_knee\) keeps position P gain = 800, expected 850"):
    bus.settings = BusSettings(position_gain=850)
    servos.set_up()


def test_set_up_survives_lost_packets(robot, bus, servos):
  robot.faults.loss = 0.02
  servos.power_on()
  servos.set_up()
  assert all(s.table["return_delay_time"] == 0 for s in robot.devices.servos.values())


def test_readings_are_the_truth_in_si_units(robot, ready):
  _wait(robot, 1.0)
  found = ready.read_joints()
  np.testing.assert_allclose(found.positions, robot.truth().joints, atol=0.002)
  motors = robot.body.motors
  np.testing.assert_allclose(found.voltages, motors.supply, atol=0.06)
  np.testing.assert_allclose(found.temperatures, motors.temperature, atol=0.5)
  assert not found.alerts.any()
  index = constants.JOINT_NAMES.index("l_el")
  robot.body.data.qvel[robot.body._dofs[index]] = 2.0
  robot.body.motors.current[index] = 0.5
  _wait(robot, 0.001)
  assert ready.read_joints().velocities[index] > 0.8


def test_each_joint_is_stamped_with_the_moment_at_which_it_was_sampled(robot, ready, servos):
  seen = {}
  for device, servo in robot.devices.servos.items():
    original = servo.read

    def read(address, length, time, original=original, device=device):
      seen[device] = time
      return original(address, length, time)

    servo.read = read
  found = ready.read_joints()
  true = np.array([seen[IDS[name]] for name in constants.JOINT_NAMES])
  np.testing.assert_allclose(found.stamps, true, atol=1e-6)
  assert 0.002 < np.ptp(found.stamps) < 0.003


def test_the_imu_is_read_in_the_torsos_axes(robot, ready):
  found = ready.read_imu()
  np.testing.assert_allclose(found.accelerometer, robot.body.imu[3:], atol=0.05)
  np.testing.assert_allclose(found.gyroscope, robot.body.imu[:3], atol=0.05)
  assert found.voltage == pytest.approx(robot.body.motors.supply, abs=0.06)


def test_goals_go_to_the_joints_they_are_meant_for(robot, ready, servos):
  servos.start()
  goal = constants.standing_targets()
  goal[constants.JOINT_NAMES.index("head_pan")] = 0.5
  ready.write_goals(goal)
  for _ in range(20):  # the servos' watchdog wants traffic
    _wait(robot, 0.05)
    ready.read_imu()
  away = robot.truth().joints - goal
  assert np.abs(away).max() < 0.08
  assert servos.torque(False)
  assert not robot.body.motors.enabled.any()


def test_switching_on_moves_nothing(robot, ready, servos):
  """The goals left from before lie elsewhere."""
  ready.write_goals(np.zeros(20))
  _wait(robot, 1.0)
  before = robot.truth().joints
  servos.start()
  peak = 0.0
  for _ in range(30):
    _wait(robot, 0.01)
    peak = max(peak, np.abs(robot.truth().joints - before).max())
  assert robot.body.motors.enabled.all()
  assert peak < 0.03


def test_switching_on_waits_until_the_joints_rest(robot, ready, servos):
  servos.start()
  servos.torque(False)
  body = robot.body
  body.model.jnt_limited[:] = 0
  index = body._dofs[constants.JOINT_NAMES.index("head_pan")]

  def spin(time, after=body.after_step):
    after(time)
    body.data.qvel[index] = 1.5

  body.after_step = spin
  with pytest.raises(BusError, match="head_pan"):
    servos.start()
  assert not body.motors.enabled.any()


@pytest.mark.parametrize("fault", [{"loss": 1.0}, {"corruption": 1.0}, {"cut": True}])
def test_lost_readings_are_none_in_bounded_time(robot, ready, fault):
  for name, value in fault.items():
    setattr(robot.faults, name, value)
  start = robot.clock.now()
  assert ready.read_joints() is None and ready.read_imu() is None
  assert robot.clock.now() - start < 0.008
  assert ready.counts.joint_losses == ready.counts.imu_losses == 1


def test_waiting_ends_at_the_deadline(robot, ready):
  robot.faults.cut = True
  start = robot.clock.now()
  assert ready.read_joints(deadline=start + 0.001) is None
  assert robot.clock.now() - start < 0.0015


def test_an_error_is_no_answer(robot, ready):
  """A servo answers a damaged instruction with an error and no data; the SDK returns the CRC."""
  robot.faults.corruption = 0.1
  assert {ready.ping(7) for _ in range(40)} <= {1020, None}
  assert {ready.read(7, 70, 1) for _ in range(40)} == {b"\0"}
  robot.faults.corruption = 0.0
  with pytest.raises(BusError, match=r"7 \(r_hip_yaw\) does not answer, or with an error"):
    ready.read(7, 146, 8)  # beyond the control table


def test_a_servo_that_has_restarted_gets_its_gains_again(robot, bus, servos):
  bus.settings = BusSettings(position_gain=400)
  servos.power_on()
  servos.set_up()
  servos.reboot("l_knee")
  servos.start()
  assert {s.table["position_p_gain"] for s in robot.devices.servos.values()} == {400}


def test_hardware_errors_are_named(robot, ready, servos):
  robot.faults.heat[13] = 90.0
  _wait(robot, 0.1)
  assert servos.hardware_errors() == {"r_knee": ["overheating"]}
  assert ready.read_joints().alerts.tolist() == [n == "r_knee" for n in constants.JOINT_NAMES]
  robot.faults.heat[13] = 40.0
  servos.reboot("r_knee")
  assert servos.hardware_errors() == {}


def test_servos_stop_by_themselves_when_the_host_is_gone(robot, ready, servos):
  servos.start()
  ready.write_goals(constants.standing_targets() + 0.2)
  _wait(robot, 0.15)
  watchdogs = {s.table["bus_watchdog"] for s in robot.devices.servos.values()}
  assert watchdogs == {-1}


@pytest.mark.parametrize("noise", [b"\xaa" * 64, b"\xff\xff\xfd\x00\x01\xff\x00\x55"])
def test_a_line_that_never_falls_silent_does_not_hold_the_reader(noise):
  # The thread that reads is the one that switches the torque off.
  master, slave = os.openpty()
  tty.setraw(slave)
  tty.setraw(master)
  os.set_blocking(master, False)
  stop = threading.Event()

  def babble():
    while not stop.is_set():
      with contextlib.suppress(BlockingIOError):
        os.write(master, noise)
        os.read(master, 4096)

  thread = threading.Thread(target=babble, daemon=True)
  thread.start()
  bus = Bus(os.ttyname(slave))
  try:
    began = time.monotonic()
    assert bus.read_joints(deadline=began + 0.02) is None
    assert bus.read_imu(deadline=began + 0.04) is None
    took = time.monotonic() - began
  finally:
    stop.set()
    thread.join()
    bus.close()
    os.close(master)
    os.close(slave)
  assert took < 0.5  # a few hundredths on an idle machine; it was endless


def test_an_adapter_that_was_unplugged_gives_lost_readings_and_no_trace():
  master, slave = os.openpty()
  tty.setraw(slave)
  bus = Bus(os.ttyname(slave))
  os.close(slave)
  os.close(master)
  try:
    assert bus.read_joints() is None and bus.read_imu() is None
    assert bus.counts.joint_losses == bus.counts.imu_losses == 1
    bus.drop_torque()
    bus.reboot(1)
    assert bus.ping(1) is None
    with pytest.raises(BusError, match="does not answer"):
      bus.read(1, 64, 1)
  finally:
    bus.close()
