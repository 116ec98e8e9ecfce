"""The virtual OpenCR board of an OP3: supply switch of the servos, IMU, battery voltage.

Sources: ROBOTIS-GIT/OpenCR, OP3 example (`dxl_node_op3.cpp`: instructions, table, ids; the chip's
values are given as they are); ROBOTIS-GIT/ROBOTIS-OP3, `open_cr_module` (16.4 counts per degree/s,
2 g full scale, x and y of the chip point against the robot's). The IMU is read at 200 Hz. A step of
a walking OP3 is felt as 3 g: such readings end at the full scale, as in
`suite.sensors.filters.saturate`.
"""

import struct

import numpy as np

from nerf2real.real.virtual.bus import registers
from nerf2real.real.virtual.bus.protocol import Error
from nerf2real.suite.sensors import filters
from nerf2real.suite.sensors.delays import DelayLine

DEVICE = 200
_GYROSCOPE_SCALE = 16.4 * 180 / np.pi  # counts per rad/s
_ACCELEROMETER_SCALE = 16384 / 9.80665  # counts per m/s^2
_CHIP_FROM_BODY = np.array([-1.0, -1.0, 1.0] * 2)
_SCALE = _CHIP_FROM_BODY * np.repeat([_GYROSCOPE_SCALE, _ACCELEROMETER_SCALE], 3)
_READ_PERIOD = 0.005  # s between the firmware's readings of the chip
_MEASURED = struct.Struct("<B6h")  # voltage (31) and IMU (32 to 43)
_MEASURED_ADDRESS = 31


class Board:
  """The OpenCR board on the bus."""

  device = DEVICE
  answers = True
  alert = False

  def __init__(self, noise: np.ndarray, rng: np.random.Generator):
    """Starts with the servos' supply off, as the board does.

    Args:
      noise: Standard deviations of the IMU's readings [6] [rad/s, m/s^2].
      rng: Source of the noise.
    """
    self._noise, self._rng = noise, rng
    self.table = registers.Table(registers.OPENCR)
    self._line = DelayLine(filters.CHIP_DELAY)
    self._next = 0.0  # s, of the next reading of the chip

  @property
  def powers(self) -> bool:
    """Whether the servos have power."""
    return bool(self.table["dynamixel_power"])

  def awake(self, time: float) -> bool:
    """Whether it has booted."""
    return True

  def sense(self, time: float, imu: np.ndarray, volts: float) -> None:
    """Takes what chip and supply give at a time [s]; the table follows at the firmware's rate."""
    self._line.push(time, imu)
    if time + 1e-9 < self._next:
      return
    self._next = max(self._next + _READ_PERIOD, time)
    values = self._line.read(time) + self._noise * self._rng.standard_normal(6)
    counts = np.clip(np.rint(values * _SCALE), -32768, 32767)
    tenths = int(np.clip(round(10 * volts), 0, 255))
    _MEASURED.pack_into(self.table.memory, _MEASURED_ADDRESS, tenths, *counts.astype(int).tolist())

  def read(self, address: int, length: int, time: float) -> tuple[int, bytes]:
    """Returns (error number, bytes) of a part of the table."""
    if address + length > self.table.size:
      return Error.LENGTH, b""
    return Error.NONE, bytes(self.table.memory[address : address + length])

  def write(self, address: int, data: bytes, time: float) -> int:
    """Writes bytes; what cannot be written is skipped without an error, as the firmware does."""
    for register in self.table.registers.values():
      place = register.address - address
      if register.writable and place >= 0 and place + register.size <= len(data):
        raw = data[place : place + register.size]
        self.table[register.name] = int.from_bytes(raw, "little", signed=register.signed)
    return Error.NONE
