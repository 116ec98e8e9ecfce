"""Control tables of the virtual robot's devices: XM430-W350 and OpenCR with the OP3 firmware.

Sources: ROBOTIS e-Manual, XM430-W350, "Control Table" (addresses, sizes, access, defaults, ranges);
ROBOTIS-GIT/OpenCR, OP3 example, `dxl_node_op3.h` (the board's table; model number 0x7400, id 200).
Numbers are little endian; those marked signed are two's complement.
"""

from typing import NamedTuple


class Register(NamedTuple):
  """One entry of a control table."""

  name: str
  address: int
  size: int  # bytes: 1, 2 or 4
  default: int = 0
  writable: bool = False
  eeprom: bool = False  # kept when the power goes; locked while torque is on
  low: int | None = None  # smallest value that may be written; None: any
  high: int | None = None
  signed: bool = False


def _eeprom(name, address, size, default, low=None, high=None, *, signed=False) -> Register:
  return Register(name, address, size, default, True, True, low, high, signed)


def _ram(name, address, size, default, low=None, high=None, *, signed=False) -> Register:
  return Register(name, address, size, default, True, False, low, high, signed)


def _shown(name, address, size, default=0, *, signed=False, eeprom=False) -> Register:
  return Register(name, address, size, default, False, eeprom, None, None, signed)


XM430_MODEL = 1020
OPENCR_MODEL = 0x7400

XM430 = (
  _shown("model_number", 0, 2, XM430_MODEL, eeprom=True),
  _shown("model_information", 2, 4, eeprom=True),
  _shown("firmware_version", 6, 1, 46, eeprom=True),
  _eeprom("id", 7, 1, 1, 0, 252),
  _eeprom("baud_rate", 8, 1, 4, 0, 7),  # 4: 2 Mbps, as an OP3's servos are set
  _eeprom("return_delay_time", 9, 1, 250, 0, 254),  # 2 us
  _eeprom("drive_mode", 10, 1, 0, 0, 13),
  _eeprom("operating_mode", 11, 1, 3, 0, 16),
  _eeprom("secondary_id", 12, 1, 255, 0, 255),
  _eeprom("protocol_type", 13, 1, 2, 1, 2),
  _eeprom("homing_offset", 20, 4, 0, -1044479, 1044479, signed=True),
  _eeprom("moving_threshold", 24, 4, 10, 0, 1023),
  _eeprom("temperature_limit", 31, 1, 80, 0, 100),  # degrees C
  _eeprom("max_voltage_limit", 32, 2, 160, 95, 160),  # 0.1 V
  _eeprom("min_voltage_limit", 34, 2, 95, 95, 160),  # 0.1 V
  _eeprom("pwm_limit", 36, 2, 885, 0, 885),
  _eeprom("current_limit", 38, 2, 1193, 0, 1193),  # 2.69 mA; not active in position mode
  _eeprom("velocity_limit", 44, 4, 200, 0, 1023),
  _eeprom("max_position_limit", 48, 4, 4095, 0, 4095),
  _eeprom("min_position_limit", 52, 4, 0, 0, 4095),
  _eeprom("startup_configuration", 60, 1, 0, 0, 3),
  _eeprom("shutdown", 63, 1, 52),  # overheating, electrical shock, overload
  _ram("torque_enable", 64, 1, 0, 0, 1),
  _ram("led", 65, 1, 0, 0, 1),
  _ram("status_return_level", 68, 1, 2, 0, 2),
  _shown("registered_instruction", 69, 1),
  _shown("hardware_error_status", 70, 1),
  _ram("velocity_i_gain", 76, 2, 1920, 0, 16383),
  _ram("velocity_p_gain", 78, 2, 100, 0, 16383),
  _ram("position_d_gain", 80, 2, 0, 0, 16383),
  _ram("position_i_gain", 82, 2, 0, 0, 16383),
  _ram("position_p_gain", 84, 2, 800, 0, 16383),
  _ram("feedforward_2nd_gain", 88, 2, 0, 0, 16383),
  _ram("feedforward_1st_gain", 90, 2, 0, 0, 16383),
  _ram("bus_watchdog", 98, 1, 0, 0, 127, signed=True),  # 20 ms
  _ram("goal_pwm", 100, 2, 885, -885, 885, signed=True),
  _ram("goal_current", 102, 2, 1193, -1193, 1193, signed=True),
  _ram("goal_velocity", 104, 4, 0, -1023, 1023, signed=True),
  _ram("profile_acceleration", 108, 4, 0, 0, 32767),
  _ram("profile_velocity", 112, 4, 0, 0, 32767),
  _ram("goal_position", 116, 4, 0, signed=True),
  _shown("realtime_tick", 120, 2),  # ms
  _shown("moving", 122, 1),
  _shown("moving_status", 123, 1),
  _shown("present_pwm", 124, 2, signed=True),  # 1/885 of the input voltage
  _shown("present_current", 126, 2, signed=True),  # 2.69 mA
  _shown("present_velocity", 128, 4, signed=True),  # 0.229 rpm
  _shown("present_position", 132, 4, signed=True),  # 2 pi/4096 rad
  _shown("velocity_trajectory", 136, 4, signed=True),
  _shown("position_trajectory", 140, 4, signed=True),
  _shown("present_input_voltage", 144, 2),  # 0.1 V
  _shown("present_temperature", 146, 1),  # degrees C
  _shown("backup_ready", 147, 1),
)

OPENCR = (
  _shown("model_number", 0, 2, OPENCR_MODEL, eeprom=True),
  _shown("firmware_version", 2, 1, 2, eeprom=True),
  _eeprom("id", 3, 1, 200),
  _eeprom("baud_rate", 4, 1, 3),
  _eeprom("return_delay_time", 5, 1, 0),  # 2 us
  _eeprom("status_return_level", 16, 1, 2),
  _eeprom("roll_offset", 18, 2, 0, signed=True),
  _eeprom("pitch_offset", 20, 2, 0, signed=True),
  _eeprom("yaw_offset", 22, 2, 0, signed=True),
  _ram("dynamixel_power", 24, 1, 0, 0, 1),
  _ram("led", 25, 1, 0),
  _ram("led_rgb", 26, 2, 0),
  _ram("buzzer", 28, 2, 0),
  _shown("button", 30, 1),
  _shown("voltage", 31, 1),  # 0.1 V
  _shown("gyro_x", 32, 2, signed=True),  # 1/16.4 degrees/s
  _shown("gyro_y", 34, 2, signed=True),
  _shown("gyro_z", 36, 2, signed=True),
  _shown("acc_x", 38, 2, signed=True),  # 1/16384 g
  _shown("acc_y", 40, 2, signed=True),
  _shown("acc_z", 42, 2, signed=True),
  _shown("roll", 44, 2, signed=True),  # 0.1 degrees
  _shown("pitch", 46, 2, signed=True),
  _shown("yaw", 48, 2, signed=True),
  _ram("imu_control", 50, 1, 0),
)


class Table:
  """The values of a device's control table, with the checks of a write."""

  def __init__(self, registers: tuple[Register, ...]):
    """Fills the table with defaults."""
    self.registers = {register.name: register for register in registers}
    self._by_address = {register.address: register for register in registers}
    self.size = max(register.address + register.size for register in registers)
    self.memory = bytearray(self.size)
    self.reset(eeprom=True)

  def __getitem__(self, name: str) -> int:
    register = self.registers[name]
    raw = self.memory[register.address : register.address + register.size]
    return int.from_bytes(raw, "little", signed=register.signed)

  def __setitem__(self, name: str, value: int) -> None:
    register = self.registers[name]
    raw = int(value).to_bytes(register.size, "little", signed=register.signed)
    self.memory[register.address : register.address + register.size] = raw

  @property
  def return_delay(self) -> float:
    """Time between an instruction and its answer [s]."""
    return 2e-6 * self["return_delay_time"]

  def reset(self, *, eeprom: bool = False) -> None:
    """Writes the defaults to the RAM area, and optionally to the EEPROM area."""
    for name, register in self.registers.items():
      if eeprom or not register.eeprom:
        self[name] = register.default

  def begins(self, address: int) -> bool:
    """Whether a register begins at an address."""
    return address in self._by_address

  def split(self, address: int, data: bytes) -> list[tuple[Register, int]] | None:
    """Returns the registers and values that bytes at an address stand for; None: they cut one."""
    found, place = [], 0
    while place < len(data):
      register = self._by_address.get(address + place)
      if register is None or place + register.size > len(data):
        return None
      raw = data[place : place + register.size]
      found.append((register, int.from_bytes(raw, "little", signed=register.signed)))
      place += register.size
    return found
