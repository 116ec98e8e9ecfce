"""The robot's bus through the DYNAMIXEL SDK: goals out, readings in.

Addresses and units: ROBOTIS e-Manual, XM430-W350; the board's: `real/wire/opencr.py`. J joints,
in the order of `suite.op3.constants.JOINT_NAMES`.
"""

import dataclasses
import threading
from collections.abc import Callable
from typing import NamedTuple

import dynamixel_sdk as sdk
import numpy as np

from nerf2real.real.clock import Clock, RealClock
from nerf2real.real.wire import op3, opencr
from nerf2real.real.wire.packets import PacketHandler
from nerf2real.real.wire.port import Port

TORQUE_ENABLE, GOAL_POSITION = 64, 116
_PRESENT = 124  # PWM, current, velocity, position, two trajectories, voltage, temperature
_ROW = np.dtype(
  [
    ("error", "u1"),
    ("id", "u1"),
    ("pwm", "<i2"),
    ("current", "<i2"),
    ("velocity", "<i4"),
    ("position", "<i4"),
    ("trajectories", "<i4", 2),
    ("voltage", "<u2"),
    ("temperature", "u1"),
    ("crc", "<u2"),
  ]
)
_PRESENT_LENGTH = _ROW.itemsize - 4
_FAST_HEAD, _STATUS_SIZE, _INSTRUCTION_SIZE = 8, 11, 14  # bytes of packets without their data
_ALERT = 0x80
_FOREIGN = 3  # packets that are taken for an answer at most: two late ones, and it
_ATTEMPTS, _PINGS = 5, 4  # of a transaction outside the cycle, of a ping


class BusError(OSError):
  """A device failed; the message names device and fault."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BusSettings:
  """Settings of the bus and of the servos' registers."""

  baud: int = 2_000_000
  """bit/s (OP3)."""
  position_gain: int = 800
  """P gain register; with D and I 0 (paper) 18.9 to 26.4 N m/rad at 12 V."""
  pwm_limit: int = 885
  """885 is the whole supply voltage."""
  return_delay: int = 0
  """2 us; the factory's 250 would cost half a millisecond a reading."""
  watchdog: float = 0.1
  """s without traffic after which servos stop by themselves; 0: never."""
  margin: float = 0.002
  """s that an answer may be late."""


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
  """Readings of all joints that arrived."""
  joint_losses: int = 0
  """Readings of all joints that were lost or damaged."""
  imu_readings: int = 0
  """Readings of the board that arrived."""
  imu_losses: int = 0
  """Readings of the board that were lost or damaged."""


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
    self.path = path
    self.counts = BusCounts()
    self._ids = self.wiring.ids
    self._directions, self._id_row = self.wiring.directions, np.array(self._ids)
    self._lock = threading.Lock()
    self._port = Port(path, baud=self.settings.baud, clock=self.clock)
    self._handler = PacketHandler()
    self._return_delay = 2e-6 * self.settings.return_delay

  def close(self) -> None:
    """Closes the port; torque stays as it is."""
    self._port.close()

  def drop_torque(self) -> None:
    """Switches all torque off at once, without waiting for answers."""
    self.write_all(TORQUE_ENABLE, 1, [0] * len(self._ids))

  # ---- the cycle ----

  def write_goals(self, angles: np.ndarray) -> None:
    """Sends position goals [J] [rad] to all servos in one sync write, without an answer."""
    self.write_all(GOAL_POSITION, 4, self.wiring.to_counts(angles).tolist())

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
          for _ in range(_FOREIGN):  # the board's late answer is not this one
            raw, result, _ = self._handler.fastSyncReadRx(port, sdk.BROADCAST_ID, size - _FAST_HEAD)
            if raw or result != sdk.COMM_SUCCESS:
              break
      except OSError:
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
      except OSError:
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
    """Repeats a transaction (result second last, error last) until it is done without an error."""
    for _ in range(attempts):
      with self._lock:
        try:
          found = transaction()
        except OSError:
          return None
        finally:
          self._port.is_using = False
      # Behind an error there is no data: the SDK would take the packet's CRC for it.
      if found[-2] == sdk.COMM_SUCCESS and not found[-1] & ~_ALERT:
        return found
    return None

  def ping(self, device: int) -> int | None:
    """Returns the model number of a device; None if it does not answer, or with an error."""
    found = self._try(lambda: self._handler.ping(self._port, device), attempts=_PINGS)
    return None if found is None else found[0]

  def read(self, device: int, address: int, size: int, *, attempts: int = _ATTEMPTS) -> bytes:
    """Returns the bytes of a device's registers.

    Raises:
      BusError: It does not answer, or with an error.
    """
    found = self._try(
      lambda: self._handler.readTxRx(self._port, device, address, size), attempts=attempts
    )
    if found is None:
      raise self._no_answer(device)
    return bytes(found[0])

  def write(self, device: int, address: int, size: int, value: int) -> None:
    """Writes a register of a device.

    Raises:
      BusError: It does not answer, or with an error.
    """
    data = list(value.to_bytes(size, "little", signed=value < 0))
    found = self._try(lambda: self._handler.writeTxRx(self._port, device, address, size, data))
    if found is None:
      raise self._no_answer(device)

  def _no_answer(self, device: int) -> BusError:
    return BusError(
      f"Device {device} ({self.wiring.name_of(device)}) does not answer, or with an error alone: "
      "check its cable and its model."
    )

  def reboot(self, device: int) -> None:
    """Restarts a device."""
    with self._lock:
      try:
        self._handler.reboot(self._port, device)
      except OSError:
        pass  # the readings notice a lost bus
      finally:
        self._port.is_using = False

  def write_all(self, address: int, size: int, values: list[int]) -> None:
    """Writes a register of every servo in one sync write, without an answer."""
    data: list[int] = []
    for device, value in zip(self._ids, values, strict=True):
      data.append(device)
      data += value.to_bytes(size, "little", signed=value < 0)
    with self._lock:
      try:
        self._handler.syncWriteTxOnly(self._port, address, size, data, len(data))
      except OSError:
        pass  # the readings notice a lost bus
      finally:
        self._port.is_using = False

  def read_all(self, address: int, size: int, *, attempts: int = _ATTEMPTS) -> list[int] | None:
    """Reads a register of every servo (unsigned); None if one does not answer."""
    group = sdk.GroupSyncRead(self._port, self._handler, address, size)
    for device in self._ids:
      group.addParam(device)
    found = self._try(lambda: (group.txRxPacket(), 0), attempts=attempts)
    if found is None:
      return None
    return [group.getData(device, address, size) for device in self._ids]
