"""Tests of the devices through the DYNAMIXEL SDK on a pseudo-terminal."""

import dynamixel_sdk as sdk
import numpy as np
import pytest

from nerf2real.real.clock import SteppedClock
from nerf2real.real.virtual.body import Body
from nerf2real.real.virtual.bus import protocol
from nerf2real.real.virtual.bus.devices import BYTE_TIME, IDS, Devices
from nerf2real.real.virtual.bus.faults import Faults
from nerf2real.real.virtual.bus.protocol import Error, Instruction
from nerf2real.real.virtual.bus.protocol_rehearsal import Cable
from nerf2real.real.virtual.bus.servo import INPUT_VOLTAGE, OVERHEATING
from nerf2real.real.virtual.bus.wire import Wire
from nerf2real.real.wire.port import Port, PortError


class Bench:
  """A body, its devices and an SDK port on a stepped clock."""

  def __init__(self, cable=Wire):
    self.clock = SteppedClock()
    self.faults = Faults()
    self.body = Body()
    self.devices = Devices(self.body, faults=self.faults)
    self.wire = cable(self.devices, self.clock)
    self.port = Port(self.wire.port, baud=2_000_000, clock=self.clock)
    self.sdk = sdk.Protocol2PacketHandler()

  def wait(self, seconds):
    self.clock.advance(self.clock.now() + seconds)
    self.body.advance(self.clock.now())

  def power(self):
    assert self.sdk.write1ByteTxRx(self.port, 200, 24, 1) == (sdk.COMM_SUCCESS, 0)
    self.wait(0.3)

  def write(self, device, address, size, value):
    data = list(value.to_bytes(size, "little", signed=value < 0))
    return self.sdk.writeTxRx(self.port, device, address, size, data)

  def read(self, device, address, size):
    data, result, error = self.sdk.readTxRx(self.port, device, address, size)
    return int.from_bytes(bytes(data), "little"), result, error

  def group(self, kind, address, size, ids):
    group = kind(self.port, self.sdk, address, size)
    for device in ids:
      group.addParam(device)
    return group


@pytest.fixture(params=[Wire, Cable], ids=["terminal", "rehearsal"])
def bench(request):
  found = Bench(request.param)
  yield found
  found.port.close()
  found.wire.close()


@pytest.fixture
def powered(bench):
  bench.power()
  return bench


def test_servos_answer_when_the_board_has_switched_their_supply_on(bench):
  assert bench.sdk.ping(bench.port, 200)[:2] == (0x7400, sdk.COMM_SUCCESS)
  assert bench.sdk.ping(bench.port, 1)[1] == sdk.COMM_RX_TIMEOUT
  bench.sdk.write1ByteTxRx(bench.port, 200, 24, 1)
  bench.wait(0.05)
  assert bench.sdk.ping(bench.port, 1)[1] == sdk.COMM_RX_TIMEOUT  # it boots
  bench.wait(0.4)
  assert bench.sdk.ping(bench.port, 1) == (1020, sdk.COMM_SUCCESS, 0)
  found, result = bench.sdk.broadcastPing(bench.port)
  assert result == sdk.COMM_SUCCESS and sorted(found) == [*range(1, 21), 200]
  bench.sdk.write1ByteTxRx(bench.port, 200, 24, 0)
  bench.wait(0.05)
  assert bench.sdk.ping(bench.port, 1)[1] == sdk.COMM_RX_TIMEOUT


@pytest.mark.parametrize(
  "address, size, value, error",
  [
    (84, 2, 900, Error.NONE),
    (84, 2, 20000, Error.RANGE),  # P gain has at most 16383
    (84, 1, 3, Error.LENGTH),  # half a register
    (85, 1, 3, Error.ACCESS),  # its other half
    (132, 4, 5, Error.ACCESS),  # present position is read only
    (14, 1, 5, Error.ACCESS),  # nothing is there
    (116, 4, 4096, Error.LIMIT),  # beyond the max position limit
    (116, 4, -1, Error.LIMIT),
  ],
)
def test_writes_are_checked(powered, address, size, value, error):
  before = powered.read(5, address, size)[0]
  assert powered.write(5, address, size, value) == (sdk.COMM_SUCCESS, error)
  after = powered.read(5, address, size)[0]
  assert after == (value if error == Error.NONE else before)


def test_torque_locks_the_eeprom(powered):
  assert powered.write(5, 9, 1, 10) == (sdk.COMM_SUCCESS, Error.NONE)
  powered.write(5, 64, 1, 1)
  assert powered.write(5, 9, 1, 20) == (sdk.COMM_SUCCESS, Error.ACCESS)
  assert powered.read(5, 9, 1)[0] == 10


def test_registered_writes_wait_for_action(powered):
  data = [0x20, 0x03]
  assert powered.sdk.regWriteTxRx(powered.port, 5, 84, 2, data) == (sdk.COMM_SUCCESS, 0)
  assert powered.read(5, 84, 2)[0] == 800 and powered.read(5, 69, 1)[0] == 1
  powered.sdk.regWriteTxRx(powered.port, 5, 84, 2, [0x84, 0x03])
  powered.sdk.action(powered.port, 0xFE)
  assert powered.read(5, 84, 2)[0] == 900 and powered.read(5, 69, 1)[0] == 0


def test_reboot_loses_ram_and_keeps_eeprom(powered):
  powered.write(5, 9, 1, 10)
  powered.write(5, 84, 2, 500)
  powered.write(5, 64, 1, 1)
  assert powered.sdk.reboot(powered.port, 5) == (sdk.COMM_SUCCESS, 0)
  assert powered.sdk.ping(powered.port, 5)[1] == sdk.COMM_RX_TIMEOUT
  powered.wait(0.4)
  assert [powered.read(5, *where)[0] for where in ((9, 1), (84, 2), (64, 1))] == [10, 800, 0]


def test_all_ways_of_reading_agree(powered):
  powered.body.motors.temperature[:] = np.arange(20) + 30.0
  ids = list(range(1, 21))
  single = {device: powered.read(device, 146, 1)[0] for device in ids}
  assert sorted(single.values()) == list(range(30, 50))
  sync = powered.group(sdk.GroupSyncRead, 144, 3, ids)
  assert sync.txRxPacket() == sdk.COMM_SUCCESS
  assert {device: sync.getData(device, 146, 1) for device in ids} == single
  assert sync.fastSyncRead() == sdk.COMM_SUCCESS
  assert {device: sync.getData(device, 146, 1) for device in ids} == single
  bulk = sdk.GroupBulkRead(powered.port, powered.sdk)
  for device in (3, 9, 200):
    bulk.addParam(device, *((31, 1) if device == 200 else (146, 1)))
  assert bulk.txRxPacket() == sdk.COMM_SUCCESS
  assert [bulk.getData(3, 146, 1), bulk.getData(9, 146, 1)] == [single[3], single[9]]
  assert bulk.getData(200, 31, 1) == round(10 * powered.body.motors.supply)
  bulk.removeParam(200)
  assert bulk.fastBulkRead() == sdk.COMM_SUCCESS
  assert [bulk.getData(3, 146, 1), bulk.getData(9, 146, 1)] == [single[3], single[9]]


def test_group_writes_reach_the_servos_they_name(powered):
  sync = sdk.GroupSyncWrite(powered.port, powered.sdk, 84, 2)
  sync.addParam(4, [0x01, 0x02])
  sync.addParam(6, [0x03, 0x02])
  assert sync.txPacket() == sdk.COMM_SUCCESS
  bulk = sdk.GroupBulkWrite(powered.port, powered.sdk)
  bulk.addParam(8, 84, 2, [0x05, 0x02])
  bulk.addParam(10, 65, 1, [1])
  assert bulk.txPacket() == sdk.COMM_SUCCESS
  found = [powered.read(device, 84, 2)[0] for device in (4, 5, 6, 8)]
  assert found == [0x201, 800, 0x203, 0x205]
  assert powered.read(10, 65, 1)[0] == 1


@pytest.mark.parametrize("return_delay", [0, 250])
def test_bytes_and_the_return_delay_take_their_time(powered, return_delay):
  powered.write(5, 9, 1, return_delay)
  start = powered.clock.now()
  powered.read(5, 132, 4)
  expected = (14 + 15) * 10 / 2e6 + 2e-6 * return_delay
  assert powered.clock.now() - start == pytest.approx(expected, abs=1e-9)


def test_a_fast_reading_of_all_joints_takes_three_milliseconds(powered):
  for device in range(1, 21):
    powered.write(device, 9, 1, 0)
  group = powered.group(sdk.GroupSyncRead, 124, 23, range(1, 21))
  start = powered.clock.now()
  assert group.fastSyncRead() == sdk.COMM_SUCCESS
  assert powered.clock.now() - start == pytest.approx((34 + 8 + 20 * 27) * BYTE_TIME, abs=1e-9)


def test_joints_of_one_reading_are_sampled_one_after_another(powered):
  """A turning joint is seen at another angle when its servo comes later in the chain."""
  for device in range(1, 21):
    powered.write(device, 9, 1, 0)
  ticks = {}
  for order in (list(range(1, 21)), list(range(20, 0, -1))):
    group = powered.group(sdk.GroupSyncRead, 120, 27, order)
    powered.wait(0.1)
    start = powered.clock.now()
    assert group.fastSyncRead() == sdk.COMM_SUCCESS
    ticks[order[0]] = [group.getData(device, 120, 2) - 1000 * start for device in (1, 20)]
  step = 31 * BYTE_TIME * 1000
  assert ticks[1][1] - ticks[1][0] == pytest.approx(19 * step, abs=1.0)
  assert ticks[20][0] - ticks[20][1] == pytest.approx(19 * step, abs=1.0)


def test_after_a_dead_servo_nobody_answers(powered):
  powered.faults.dead.add(3)
  group = powered.group(sdk.GroupSyncRead, 132, 4, [1, 2, 3, 4])
  assert group.txRxPacket() == sdk.COMM_RX_TIMEOUT
  assert group.data_dict[2] and not group.data_dict[4]
  assert group.fastSyncRead() != sdk.COMM_SUCCESS
  assert powered.sdk.ping(powered.port, 4)[1] == sdk.COMM_SUCCESS
  assert powered.sdk.ping(powered.port, 3)[1] == sdk.COMM_RX_TIMEOUT


def test_lost_and_damaged_packets_have_their_share(powered):
  powered.faults.loss = 0.2
  lost = sum(powered.sdk.ping(powered.port, 5)[1] == sdk.COMM_RX_TIMEOUT for _ in range(400))
  assert 0.28 < lost / 400 < 0.44  # either way: 1 - 0.8^2 = 0.36
  powered.faults.loss, powered.faults.corruption = 0.0, 1.0
  results = [powered.sdk.ping(powered.port, 5)[1] for _ in range(20)]
  assert sdk.COMM_SUCCESS not in results


def test_a_damaged_instruction_is_refused(powered):
  good = protocol.packet(5, Instruction.WRITE, bytes((84, 0, 1, 0)))
  bad = good[:-1] + bytes((good[-1] ^ 1,))
  powered.port.clearPort()
  powered.port.writePort(bad)
  powered.port.setPacketTimeoutMillis(5)
  raw, result = powered.sdk.rxPacket(powered.port, False)
  assert result == sdk.COMM_SUCCESS and raw[8] == Error.CRC
  assert powered.read(5, 84, 2)[0] == 800


def test_late_answers_come_late(powered):
  powered.faults.late, powered.faults.lateness = 1.0, 0.02
  start = powered.clock.now()
  assert powered.sdk.ping(powered.port, 5)[1] == sdk.COMM_SUCCESS
  assert powered.clock.now() - start > 0.02


def test_heat_alerts_and_shuts_down(powered):
  powered.write(5, 64, 1, 1)
  powered.faults.heat[5] = 85.0
  powered.wait(0.05)
  value, _, error = powered.read(5, 70, 1)
  assert value == OVERHEATING and error == protocol.ALERT
  assert powered.read(5, 64, 1)[0] == 0
  assert powered.write(5, 64, 1, 1)[1] & 0x7F == Error.RESULT  # not before it was rebooted
  powered.faults.heat[5] = 40.0
  powered.wait(0.05)
  powered.sdk.reboot(powered.port, 5)
  powered.wait(0.4)
  assert powered.read(5, 70, 1) == (0, sdk.COMM_SUCCESS, 0)


def test_a_brown_out_alerts_and_a_deep_one_resets(powered):
  powered.write(5, 84, 2, 500)
  powered.faults.voltage = 9.0
  powered.wait(0.3)
  assert powered.read(5, 70, 1)[0] == INPUT_VOLTAGE
  assert powered.read(5, 144, 2)[0] == 90
  powered.faults.voltage = 5.0
  powered.wait(0.1)
  assert powered.sdk.ping(powered.port, 5)[1] == sdk.COMM_RX_TIMEOUT
  powered.faults.voltage = None
  powered.wait(0.4)
  assert powered.read(5, 84, 2)[0] == 800


def test_a_stuck_encoder_keeps_its_value(powered):
  device, index = IDS["l_el"], 4
  powered.faults.stuck.add(device)
  powered.wait(0.02)
  before = powered.read(device, 132, 4)[0]
  powered.body.data.qpos[powered.body._qpos[index]] += 0.5
  powered.wait(0.02)
  assert powered.read(device, 132, 4)[0] == before
  powered.faults.stuck.clear()
  powered.wait(0.02)
  assert abs(powered.read(device, 132, 4)[0] - before) > 100


def test_the_watchdog_stops_a_servo_that_hears_nothing(powered):
  here = powered.read(5, 132, 4)[0]
  powered.write(5, 116, 4, here)
  powered.write(5, 64, 1, 1)
  powered.write(5, 98, 1, 5)  # 100 ms
  powered.write(5, 116, 4, here + 300)
  powered.wait(0.09)
  assert powered.read(5, 98, 1)[0] == 5
  powered.wait(0.2)
  assert powered.read(5, 98, 1)[0] == 255
  assert powered.write(5, 116, 4, here)[1] == Error.RANGE
  assert powered.write(5, 98, 1, 0)[1] == Error.NONE
  assert powered.write(5, 116, 4, here)[1] == Error.NONE


def test_a_cut_cable_carries_nothing(powered):
  powered.faults.cut = True
  assert powered.sdk.ping(powered.port, 200)[1] == sdk.COMM_RX_TIMEOUT
  powered.faults.cut = False
  assert powered.sdk.ping(powered.port, 200)[1] == sdk.COMM_SUCCESS


def test_a_rehearsal_takes_the_same_time_as_a_pseudo_terminal():
  """Byte for byte and to the microsecond, lost packets included."""
  found = []
  for cable in (Wire, Cable):
    bench = Bench(cable)
    try:
      bench.power()
      bench.faults.loss = 0.2
      reads = [bench.read(1 + index % 20, 132, 4) for index in range(40)]
      found.append((reads, bench.clock.now()))
    finally:
      bench.port.close()
      bench.wire.close()
  assert found[0] == found[1]
  assert any(result != sdk.COMM_SUCCESS for _, result, _ in found[0][0])


def test_an_unplugged_rehearsal_is_said():
  with pytest.raises(PortError, match="no rehearsal is plugged in as rehearsal://0"):
    Port("rehearsal://0", baud=2_000_000, clock=SteppedClock())
