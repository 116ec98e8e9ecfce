"""The robot's bus through the DYNAMIXEL SDK: goals out, readings in, registers verified.

Addresses and units: ROBOTIS e-Manual, XM430-W350; the board's: `real/opencr.py`. J joints, in the
order of `suite.op3.constants.JOINT_NAMES`.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import NamedTuple

import dynamixel_sdk as sdk
import numpy as np
import serial

from real import op3, opencr
from real.clock import Clock, RealClock
from real.port import Port

TORQUE_ENABLE, HARDWARE_ERROR, BUS_WATCHDOG, GOAL_POSITION = 64, 70, 98, 116
XM430_W350 = 1020  # model number
_PRESENT = 124  # PWM, current, velocity, position, two trajectories, voltage, temperature
_ROW = np.dtype(
  [
    ("error", "u1"), ("id", "u1"), ("pwm", "<i2"), ("current", "<i2"), ("velocity", "<i4"),
    ("position", "<i4"), ("trajectories", "<i4", 2), ("voltage", "<u2"), ("temperature", "u1"),
    ("crc", "<u2"),
  ]
)  # fmt: skip
_PRESENT_LENGTH = _ROW.itemsize - 4
_FAST_HEAD, _STATUS_SIZE, _INSTRUCTION_SIZE = 8, 11, 14  # bytes of packets without their data
_ALERT = 0x80
_ATTEMPTS, _PINGS = 5, 4  # of a transaction outside the cycle, of a ping
_BOOT_TIME = 0.5  # s for servos to answer after their supply is switched on
_WATCHDOG_UNIT = 0.020  # s
_REST_PATIENCE, _REST_INTERVAL, _REST_COUNTS = 5.0, 0.05, 20  # s, s, counts: 0.6 rad/s at most
ERROR_BITS = {
  0x01: "input voltage", 0x04: "overheating", 0x08: "encoder", 0x10: "electrical shock",
  0x20: "overload",
}  # fmt: skip


class BusError(OSError):
  """A device does not do what it should; the message says which and what."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BusSettings:
  """Settings of the bus and of the servos' registers."""

  baud: int = 2_000_000  # bit/s (OP3)
  position_gain: int = 800  # P gain register; with D and I 0 (paper) 18.9 to 26.4 N m/rad at 12 V
  pwm_limit: int = 885  # 885 is the whole supply voltage
  return_delay: int = 0  # 2 us; the factory's 250 would cost half a millisecond a reading
  watchdog: float = 0.1  # s without traffic after which servos stop by themselves; 0: never
  margin: float = 0.002  # s that an answer may be late


class JointReading(NamedTuple):
  """One reading of all joints."""

  stamps: np.ndarray  # [J] s, when each servo was sampled (clock of the bus)
  positions: np.ndarray  # [J] rad
  velocities: np.ndarray  # [J] rad/s
  currents: np.ndarray  # [J] A
  voltages: np.ndarray  # [J] V
  temperatures: np.ndarray  # [J] degrees C
  pwm: np.ndarray  # [J] share of the supply voltage
  alerts: np.ndarray  # [J] bool: the servo's hardware error status is not zero


@dataclasses.dataclass
class BusCounts:
  """What became of the readings so far."""

  joint_readings: int = 0
  joint_losses: int = 0
  imu_readings: int = 0
  imu_losses: int = 0


class Bus:
  """The servos and the board of an OP3. Threads may call it; one transaction runs at a time."""

  def __init__(
    self,
    path: str,
    *,
    settings: BusSettings | None = None,
    wiring: op3.Wiring | None = None,
    clock: Clock | None = None,
  ):
    """Opens the port; nothing is written.

    Args:
      path: Serial port.
      settings: Settings of bus and servos.
      wiring: Ids, directions and offsets.
      clock: Time; the machine's if None.

    Raises:
      PortError: The port cannot be used.
    """
    self.settings = settings or BusSettings()
    self.wiring = wiring or op3.Wiring()
    self.clock = clock or RealClock()
    self.counts = BusCounts()
    self._ids = self.wiring.ids
    self._directions, self._id_row = self.wiring.directions, np.array(self._ids)
    self._lock = threading.Lock()
    self._port = Port(path, baud=self.settings.baud, clock=self.clock)
    self._handler = sdk.Protocol2PacketHandler()
    self._return_delay = 2e-6 * self.settings.return_delay

  # ---- start and end ----

  def power_on(self) -> None:
    """Switches the servos' supply on and waits until all devices answer.

    Raises:
      BusError: The board or a servo does not answer, or is another model.
    """
    if self._ping(op3.BOARD_ID) is None:
      raise BusError(
        f"The OpenCR board (id {op3.BOARD_ID}) does not answer on {self._port.port_name}: is the "
        "robot switched on, is this its port, does another program use it?"
      )
    if not self._read(op3.BOARD_ID, opencr.POWER, 1)[0]:
      self._write(op3.BOARD_ID, opencr.POWER, 1, 1)
      self.clock.sleep_until(self.clock.now() + _BOOT_TIME)
    silent = self.silent()
    if silent:
      raise BusError(f"These devices do not answer: {', '.join(silent)}. Check their cables.")
    for joint in self.wiring.joints:
      model = self._ping(joint.device)
      if model != XM430_W350:
        raise BusError(
          f"Servo {joint.device} ({joint.name}) has model number {model}, expected {XM430_W350} "
          "(XM430-W350)."
        )

  def silent(self) -> list[str]:
    """Returns the devices that do not answer a ping."""
    return [
      f"{device} ({self.wiring.name_of(device)})"
      for device in (*sorted(self._ids), op3.BOARD_ID)
      if self._ping(device) is None
    ]

  def set_up(self) -> None:
    """Switches torque off, writes the servos' registers and verifies them by reading back.

    Raises:
      BusError: A register holds another value afterwards.
    """
    values = self.settings
    self.torque(False)
    self._write_all(BUS_WATCHDOG, 1, [0] * len(self._ids))
    wanted = {  # address: (size, value, name)
      9: (1, values.return_delay, "return delay time"),
      10: (1, 0, "drive mode"),
      11: (1, 3, "operating mode"),  # position control
      20: (4, 0, "homing offset"),
      36: (2, values.pwm_limit, "PWM limit"),
      48: (4, 4095, "max position limit"),
      52: (4, 0, "min position limit"),
      80: (2, 0, "position D gain"),
      82: (2, 0, "position I gain"),
      84: (2, values.position_gain, "position P gain"),
      108: (4, 0, "profile acceleration"),
      112: (4, 0, "profile velocity"),
    }
    for address, (size, value, name) in wanted.items():
      self._set_all(address, size, [value] * len(self._ids), name=name)

  def _set_all(self, address: int, size: int, values: list[int], *, name: str) -> None:
    """Writes a register of every servo and reads it back."""
    found: list[int] | None = None
    for _ in range(_ATTEMPTS):
      self._write_all(address, size, values)
      found = self._read_all(address, size)
      if found == values:
        return
    if found is None:
      raise BusError(f"The servos do not answer: {', '.join(self.silent()) or 'lost packets'}.")
    rows = zip(self.wiring.joints, found, values, strict=True)
    joint, got, value = next(row for row in rows if row[1] != row[2])
    raise BusError(
      f"Servo {joint.device} ({joint.name}) keeps {name} = {got}, expected {value}: its registers "
      "are locked or it has an error; see its hardware error status."
    )

  def start(self) -> None:
    """Switches torque on with every joint's goal where it is, and the servos' watchdog on.

    Raises:
      BusError: The joints cannot be read or do not come to rest, or a servo refuses.
    """
    counts = self._resting_counts()
    self._set_all(GOAL_POSITION, 4, counts, name="goal position")
    self._set_all(TORQUE_ENABLE, 1, [1] * len(self._ids), name="torque enable")
    watchdog = round(self.settings.watchdog / _WATCHDOG_UNIT)
    if watchdog:
      self._set_all(BUS_WATCHDOG, 1, [watchdog] * len(self._ids), name="bus watchdog")

  def _resting_counts(self) -> list[int]:
    """Waits until no joint moves; returns the servos' positions."""
    end = self.clock.now() + _REST_PATIENCE
    moving: list[str] = []
    before: np.ndarray | None = None
    while self.clock.now() < end:
      values = self._read_all(132, 4)
      if values is None:
        raise BusError("The joints' positions cannot be read, so torque stays off.")
      counts = np.array(values, np.uint32).astype(np.int32)
      if before is not None:
        still = np.abs(counts - before) <= _REST_COUNTS
        if still.all():
          return np.clip(counts, 0, 4095).tolist()
        moving = [joint.name for joint, rest in zip(self.wiring.joints, still, strict=True)
                  if not rest]  # fmt: skip
      before = counts
      self.clock.sleep_until(self.clock.now() + _REST_INTERVAL)
    raise BusError(f"These joints keep moving, so torque stays off: {', '.join(moving)}.")

  def torque(self, enabled: bool) -> bool:
    """Switches the torque of all servos; returns whether all confirmed it."""
    value = int(enabled)
    for _ in range(_ATTEMPTS):
      self._write_all(TORQUE_ENABLE, 1, [value] * len(self._ids))
      if self._read_all(TORQUE_ENABLE, 1) == [value] * len(self._ids):
        return True
    return False

  def drop_torque(self) -> None:
    """Switches all torque off at once, without waiting for answers."""
    self._write_all(TORQUE_ENABLE, 1, [0] * len(self._ids))

  def torque_states(self) -> list[int | None]:
    """Returns the servos' torque enable [J]; None where a servo does not answer."""
    states = self._read_all(TORQUE_ENABLE, 1, attempts=1)
    if states is not None:
      return list(states)
    found: list[int | None] = []
    for device in self._ids:  # a dead servo silences those behind it in a common answer
      read = functools.partial(self._handler.read1ByteTxRx, self._port, device, TORQUE_ENABLE)
      answer = self._try(read, attempts=1)
      found.append(None if answer is None else answer[0])
    return found

  def hardware_errors(self) -> dict[str, list[str]]:
    """Returns the names of the errors that servos report, by joint."""
    found = {}
    for joint in self.wiring.joints:
      try:
        status = self._read(joint.device, HARDWARE_ERROR, 1)[0]
      except BusError:
        continue
      if status:
        found[joint.name] = [name for bit, name in ERROR_BITS.items() if status & bit]
    return found

  def reboot(self, name: str) -> None:
    """Restarts the servo of a joint, which clears its hardware errors."""
    device = self._ids[[joint.name for joint in self.wiring.joints].index(name)]
    with self._lock:
      self._handler.reboot(self._port, device)
    self.clock.sleep_until(self.clock.now() + _BOOT_TIME)

  def close(self) -> None:
    """Closes the port; torque stays as it is."""
    self._port.close()

  # ---- the cycle ----

  def write_goals(self, angles: np.ndarray) -> None:
    """Sends position goals [J] [rad] to all servos in one packet, which nobody answers."""
    self._write_all(GOAL_POSITION, 4, self.wiring.to_counts(angles).tolist())

  def read_joints(self, *, deadline: float | None = None) -> JointReading | None:
    """Reads all joints with one fast sync read.

    Args:
      deadline: Time [s] after which it no longer waits.

    Returns:
      The reading; None if it was lost or damaged.
    """
    count = len(self._ids)
    size = _FAST_HEAD + count * _ROW.itemsize
    with self._lock:
      port, clock = self._port, self.clock
      port.deadline = deadline
      sent = clock.now()
      try:
        result = self._handler.syncReadTx(port, _PRESENT, _PRESENT_LENGTH, self._ids, count, True)
        raw: list[int] = []
        if result == sdk.COMM_SUCCESS:
          self._expect(_INSTRUCTION_SIZE + count + size, delay=self._return_delay)
          raw, result, _ = self._handler.fastSyncReadRx(port, sdk.BROADCAST_ID, size - _FAST_HEAD)
      except (serial.SerialException, OSError):
        result, raw = sdk.COMM_RX_FAIL, []
      finally:
        port.deadline = None
        port.is_using = False
      received = clock.now()
    if result != sdk.COMM_SUCCESS or len(raw) != size - _FAST_HEAD:
      self.counts.joint_losses += 1
      return None
    rows = np.frombuffer(bytes(raw), _ROW)
    if not np.array_equal(rows["id"], self._id_row):
      self.counts.joint_losses += 1
      return None
    self.counts.joint_readings += 1
    return JointReading(
      stamps=self._stamps(sent, received, size),
      positions=self.wiring.to_angles(rows["position"]),
      velocities=self._directions * rows["velocity"] * op3.SPEED_UNIT,
      currents=self._directions * rows["current"] * op3.CURRENT_UNIT,
      voltages=rows["voltage"] * op3.VOLTAGE_UNIT,
      temperatures=rows["temperature"].astype(np.float64),
      pwm=self._directions * rows["pwm"] * op3.PWM_UNIT,
      alerts=(rows["error"] & _ALERT) != 0,
    )

  def _stamps(self, sent: float, received: float, size: int) -> np.ndarray:
    """Returns when each servo was sampled [J] [s].

    Each begins its part when the one before has ended. What the reading took longer than the wire
    needs is the adapter's and the scheduler's, half of it before and half after.
    """
    byte = self._port.byte_time
    count = len(self._ids)
    instruction = (_INSTRUCTION_SIZE + count) * byte + self._return_delay
    spare = max(0.0, received - sent - instruction - size * byte)
    first = sent + spare / 2 + instruction + _FAST_HEAD * byte
    return first + np.arange(count) * _ROW.itemsize * byte

  def read_imu(self, *, deadline: float | None = None) -> "opencr.ImuReading | None":
    """Reads the board's IMU and supply voltage; None if the answer was lost or damaged."""
    with self._lock:
      port, clock = self._port, self.clock
      port.deadline = deadline
      sent = clock.now()
      try:
        result = self._handler.readTx(port, op3.BOARD_ID, opencr.MEASURED, opencr.MEASURED_LENGTH)
        raw: list[int] = []
        if result == sdk.COMM_SUCCESS:
          self._expect(_INSTRUCTION_SIZE + _STATUS_SIZE + opencr.MEASURED_LENGTH, delay=0.0)
          raw, result, _ = self._handler.readRx(port, op3.BOARD_ID, opencr.MEASURED_LENGTH)
      except (serial.SerialException, OSError):
        result, raw = sdk.COMM_RX_FAIL, []
      finally:
        port.deadline = None
        port.is_using = False
      received = clock.now()
    if result != sdk.COMM_SUCCESS or len(raw) != opencr.MEASURED_LENGTH:
      self.counts.imu_losses += 1
      return None
    self.counts.imu_readings += 1
    answer = (_STATUS_SIZE + opencr.MEASURED_LENGTH) * self._port.byte_time
    spare = max(0.0, received - sent - answer - _INSTRUCTION_SIZE * self._port.byte_time)
    return opencr.decode(received - answer - spare / 2, bytes(raw))

  # ---- transactions ----

  def _expect(self, size: int, *, delay: float) -> None:
    self._port.expect(size, delay=delay, margin=self.settings.margin)

  def _try(self, transaction: Callable[[], tuple], *, attempts: int = _ATTEMPTS) -> tuple | None:
    """Repeats a transaction (result second last, error last) until it is answered."""
    for _ in range(attempts):
      with self._lock:
        try:
          found = transaction()
        except (serial.SerialException, OSError):
          return None
        finally:
          self._port.is_using = False
      if found[-2] == sdk.COMM_SUCCESS:
        return found
    return None

  def _ping(self, device: int) -> int | None:
    found = self._try(lambda: self._handler.ping(self._port, device), attempts=_PINGS)
    return None if found is None else found[0]

  def _read(self, device: int, address: int, size: int) -> bytes:
    found = self._try(lambda: self._handler.readTxRx(self._port, device, address, size))
    if found is None:
      raise BusError(f"Device {device} ({self.wiring.name_of(device)}) does not answer.")
    return bytes(found[0])

  def _write(self, device: int, address: int, size: int, value: int) -> None:
    data = list(value.to_bytes(size, "little", signed=value < 0))
    found = self._try(lambda: self._handler.writeTxRx(self._port, device, address, size, data))
    if found is None:
      raise BusError(f"Device {device} ({self.wiring.name_of(device)}) does not answer.")

  def _write_all(self, address: int, size: int, values: list[int]) -> None:
    data: list[int] = []
    for device, value in zip(self._ids, values, strict=True):
      data.append(device)
      data += value.to_bytes(size, "little", signed=value < 0)
    with self._lock:
      try:
        self._handler.syncWriteTxOnly(self._port, address, size, data, len(data))
      except (serial.SerialException, OSError):
        pass  # the readings notice a lost bus
      finally:
        self._port.is_using = False

  def _read_all(self, address: int, size: int, *, attempts: int = _ATTEMPTS) -> list[int] | None:
    """Reads a register of every servo (unsigned); None if one does not answer."""
    group = sdk.GroupSyncRead(self._port, self._handler, address, size)
    for device in self._ids:
      group.addParam(device)
    found = self._try(lambda: (group.txRxPacket(), 0), attempts=attempts)
    if found is None:
      return None
    return [group.getData(device, address, size) for device in self._ids]
