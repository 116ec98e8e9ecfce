"""One virtual XM430-W350: its control table, what writing to it does, its protections.

Sources: ROBOTIS e-Manual, XM430-W350 (torque enable locks the EEPROM area; hardware error status 70
and shutdown 63; reboot clears them; bus watchdog 98 stops the servo, locks its goal and reads -1
until 0 is written). P-only position mode: D and I gains and profiles are kept, not acted upon.
"""

import struct

from nerf2real.real.virtual.bus import registers
from nerf2real.real.virtual.bus.protocol import Error
from nerf2real.real.virtual.motors import CURRENT_UNIT, FULL_PWM, SPEED_UNIT, Motors

BOOT_TIME = 0.25  # s without answers after power-up or reboot: chosen
_PRESENT = struct.Struct("<HBBhhiiiiHB")  # realtime tick (120) to present temperature (146)
_PRESENT_ADDRESS = 120
_WATCHDOG_UNIT = 0.020  # s
_WATCHDOG_EXPIRED = -1
_MOVING_SPEED = 10 * SPEED_UNIT  # the default moving threshold

# Bits of the hardware error status (and of the shutdown mask).
INPUT_VOLTAGE, OVERHEATING, ENCODER, SHOCK, OVERLOAD = 0x01, 0x04, 0x08, 0x10, 0x20


class Servo:
  """A servo on the bus; `index` is its place in `Motors`."""

  def __init__(self, device: int, index: int, motors: Motors):
    """Makes the servo.

    Args:
      device: Its id.
      index: Its place in `motors`.
      motors: The motors of all servos.
    """
    self.device = device
    self.table = registers.Table(registers.XM430)
    self.table["id"] = device
    self._index, self._motors = index, motors
    self._answers_from = 0.0  # s
    self._heard = 0.0  # s, time of the last packet on the bus
    self._pending: tuple[int, bytes] | None = None
    self._apply_all(0.0)

  @property
  def answers(self) -> bool:
    """Whether instructions other than ping and read are answered."""
    return self.table["status_return_level"] == 2

  @property
  def alert(self) -> bool:
    """Whether the hardware error status is not zero."""
    return self.table["hardware_error_status"] != 0

  def awake(self, time: float) -> bool:
    """Whether it has booted."""
    return time >= self._answers_from

  def boot(self, time: float) -> None:
    """Starts again: RAM values are lost, torque is off, errors are cleared."""
    self.table.reset()
    self._pending = None
    self._answers_from = time + BOOT_TIME
    self._apply_all(time)

  def read(self, address: int, length: int, time: float) -> tuple[int, bytes]:
    """Returns (error number, bytes) of a part of the table as it is at a time [s]."""
    if address + length > self.table.size:
      return Error.ACCESS, b""
    self._refresh(time)
    return Error.NONE, bytes(self.table.memory[address : address + length])

  def write(self, address: int, data: bytes, time: float) -> int:
    """Writes bytes that arrived at a time [s]; returns the error number."""
    values = self.table.split(address, data)
    if values is None:
      return Error.LENGTH if self.table.begins(address) else Error.ACCESS
    for register, value in values:
      error = self._check(register, value)
      if error:
        return error
      self._store(register.name, value, time)
    return Error.NONE

  def register_write(self, address: int, data: bytes) -> int:
    """Keeps a write for `action`."""
    self._pending = (address, data)
    self.table["registered_instruction"] = 1
    return Error.NONE

  def action(self, time: float) -> int:
    """Does the write that was kept."""
    if self._pending is None:
      return Error.INSTRUCTION
    address, data = self._pending
    self._pending = None
    self.table["registered_instruction"] = 0
    return self.write(address, data, time)

  def hear(self, time: float) -> None:
    """Notes that there was traffic on the bus at a time [s]."""
    self._heard = time

  def protect(self, time: float) -> None:
    """Checks temperature, voltage and the bus watchdog; may switch the torque off."""
    table, motors, index = self.table, self._motors, self._index
    errors = 0
    if motors.temperature[index] > table["temperature_limit"]:
      errors |= OVERHEATING
    volts = round(10 * motors.slow_supply)
    if not table["min_voltage_limit"] <= volts <= table["max_voltage_limit"]:
      errors |= INPUT_VOLTAGE
    if errors:
      table["hardware_error_status"] |= errors
      if errors & table["shutdown"] and table["torque_enable"]:
        self._store("torque_enable", 0, time)
    watchdog = table["bus_watchdog"]
    if watchdog > 0 and time - self._heard > watchdog * _WATCHDOG_UNIT:
      table["bus_watchdog"] = _WATCHDOG_EXPIRED
      motors.set_goal(index, int(motors.counts[index]), time)  # stays where it is

  def _check(self, register: registers.Register, value: int) -> int:
    table = self.table
    if not register.writable:
      return Error.ACCESS
    if register.eeprom and table["torque_enable"]:
      return Error.ACCESS
    if register.low is not None and not register.low <= value <= (register.high or 0):
      return Error.RANGE
    if register.name == "goal_position":
      if table["bus_watchdog"] == _WATCHDOG_EXPIRED:
        return Error.RANGE
      if not table["min_position_limit"] <= value <= table["max_position_limit"]:
        return Error.LIMIT
    if register.name == "torque_enable" and value and self._shut_down():
      return Error.RESULT
    return Error.NONE

  def _shut_down(self) -> bool:
    return bool(self.table["hardware_error_status"] & self.table["shutdown"])

  def _store(self, name: str, value: int, time: float) -> None:
    motors, index = self._motors, self._index
    self.table[name] = value
    if name == "goal_position":
      motors.set_goal(index, value, time)
    elif name == "torque_enable":
      motors.enabled[index] = bool(value)
    elif name == "position_p_gain":
      motors.p_gain[index] = value
    elif name == "pwm_limit":
      motors.pwm_limit[index] = value
    elif name == "bus_watchdog":
      self._heard = time

  def _apply_all(self, time: float) -> None:
    motors, index = self._motors, self._index
    self.table["goal_position"] = int(motors.counts[index])
    for name in ("goal_position", "torque_enable", "position_p_gain", "pwm_limit"):
      self._store(name, self.table[name], time)

  def _refresh(self, time: float) -> None:
    """Writes what is measured into the table."""
    motors, index = self._motors, self._index
    speed = motors.speed[index]
    counts = int(motors.counts[index])
    _PRESENT.pack_into(
      self.table.memory,
      _PRESENT_ADDRESS,
      int(1000 * time) & 0x7FFF,
      int(abs(speed) > _MOVING_SPEED),
      0,
      round(motors.duty[index] * FULL_PWM),
      round(motors.current[index] / CURRENT_UNIT),
      round(speed / SPEED_UNIT),
      counts,
      0,
      int(motors.goal[index]),
      max(0, round(10 * motors.supply)),
      round(min(255.0, motors.temperature[index])),
    )
