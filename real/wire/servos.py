"""The robot's servos outside the cycle: supply, registers written and verified, torque, errors.

Addresses: ROBOTIS e-Manual, XM430-W350. J joints, in the order of `constants.JOINT_NAMES`.
"""

import numpy as np

from nerf2real.real.wire import op3, opencr
from nerf2real.real.wire.bus import TORQUE_ENABLE, Bus, BusError

HARDWARE_ERROR, BUS_WATCHDOG, GOAL_POSITION, PRESENT_POSITION = 70, 98, 116, 132
XM430_W350 = 1020  # model number
_ATTEMPTS = 5  # to write a register
_BOOT_TIME = 0.5  # s for servos to answer after their supply is switched on
_WATCHDOG_UNIT = 0.020  # s
_REST_PATIENCE, _REST_INTERVAL, _REST_COUNTS = 5.0, 0.05, 20  # s, s, counts: 0.6 rad/s at most
ERROR_BITS = {
  0x01: "input voltage",
  0x04: "overheating",
  0x08: "encoder",
  0x10: "electrical shock",
  0x20: "overload",
}


class Servos:
  """Sets up and switches the servos on a bus."""

  def __init__(self, bus: Bus):
    """Takes an open bus; nothing is written."""
    self._bus = bus
    self._count = len(bus.wiring.ids)

  def power_on(self) -> None:
    """Switches the servos' supply on and waits until all devices answer.

    Raises:
      BusError: The board or a servo does not answer, or is another model.
    """
    if self._bus.ping(op3.BOARD_ID) is None:
      raise BusError(
        f"The OpenCR board (id {op3.BOARD_ID}) does not answer on {self._bus.path}: is the "
        "robot switched on, is this its port, does another program use it?"
      )
    if not self._bus.read(op3.BOARD_ID, opencr.POWER, 1)[0]:
      self._bus.write(op3.BOARD_ID, opencr.POWER, 1, 1)
      self._bus.clock.sleep_until(self._bus.clock.now() + _BOOT_TIME)
    silent = self.silent()
    if silent:
      raise BusError(f"These devices do not answer: {', '.join(silent)}. Check their cables.")
    for joint in self._bus.wiring.joints:
      model = self._bus.ping(joint.device)
      if model != XM430_W350:
        raise BusError(
          f"Servo {joint.device} ({joint.name}) has model number {model}, expected {XM430_W350} "
          "(XM430-W350)."
        )

  def silent(self) -> list[str]:
    """Returns the devices that do not answer a ping."""
    return [
      f"{device} ({self._bus.wiring.name_of(device)})"
      for device in (*sorted(self._bus.wiring.ids), op3.BOARD_ID)
      if self._bus.ping(device) is None
    ]

  def set_up(self) -> None:
    """Switches torque off, writes the servos' registers and verifies them by reading back.

    Raises:
      BusError: A register holds another value afterwards.
    """
    values = self._bus.settings
    self.torque(False)
    kept = {  # address: (size, value, name)
      9: (1, values.return_delay, "return delay time"),
      10: (1, 0, "drive mode"),
      11: (1, 3, "operating mode"),  # position control
      20: (4, 0, "homing offset"),
      36: (2, values.pwm_limit, "PWM limit"),
      48: (4, 4095, "max position limit"),
      52: (4, 0, "min position limit"),
    }
    for address, (size, value, name) in kept.items():
      self._set_all(address, size, [value] * self._count, name=name)
    self._set_volatile()

  def _set_volatile(self) -> None:
    """Writes the registers that a servo loses when it restarts, and its watchdog off."""
    wanted = {  # address: (size, value, name)
      BUS_WATCHDOG: (1, 0, "bus watchdog"),  # one that has run out refuses goals
      80: (2, 0, "position D gain"),
      82: (2, 0, "position I gain"),
      84: (2, self._bus.settings.position_gain, "position P gain"),
      108: (4, 0, "profile acceleration"),
      112: (4, 0, "profile velocity"),
    }
    for address, (size, value, name) in wanted.items():
      self._set_all(address, size, [value] * self._count, name=name)

  def _set_all(self, address: int, size: int, values: list[int], *, name: str) -> None:
    """Writes a register of every servo and reads it back."""
    found: list[int] | None = None
    for _ in range(_ATTEMPTS):
      self._bus.write_all(address, size, values)
      found = self._bus.read_all(address, size)
      if found == values:
        return
    if found is None:
      raise BusError(f"The servos do not answer: {', '.join(self.silent()) or 'lost packets'}.")
    rows = zip(self._bus.wiring.joints, found, values, strict=True)
    joint, got, value = next(row for row in rows if row[1] != row[2])
    raise BusError(
      f"Servo {joint.device} ({joint.name}) keeps {name} = {got}, expected {value}: its registers "
      "are locked or it has an error; see its hardware error status."
    )

  def prepare(self) -> list[int]:
    """Gets the servos ready to be switched on; returns their positions at rest [J] [counts].

    What a restart or a lost bus has changed since `set_up` is written anew. Torque stays off.

    Raises:
      BusError: The joints cannot be read or do not come to rest, or a servo refuses.
    """
    self._set_volatile()
    return self._resting_counts()

  def start(self, counts: list[int] | None = None) -> None:
    """Switches torque on with every joint's goal where it is, and the servos' watchdog on.

    Args:
      counts: What `prepare` returned just now; it is called if None.

    Raises:
      BusError: The joints cannot be read or do not come to rest, or a servo refuses.
    """
    if counts is None:
      counts = self.prepare()
    self._set_all(GOAL_POSITION, 4, counts, name="goal position")
    self._set_all(TORQUE_ENABLE, 1, [1] * self._count, name="torque enable")
    watchdog = round(self._bus.settings.watchdog / _WATCHDOG_UNIT)
    if watchdog:
      self._set_all(BUS_WATCHDOG, 1, [watchdog] * self._count, name="bus watchdog")

  def _resting_counts(self) -> list[int]:
    """Waits until no joint moves; returns the servos' positions."""
    end = self._bus.clock.now() + _REST_PATIENCE
    moving: list[str] = []
    before: np.ndarray | None = None
    while self._bus.clock.now() < end:
      values = self._bus.read_all(PRESENT_POSITION, 4)
      if values is None:
        raise BusError("The joints' positions cannot be read, so torque stays off.")
      counts = np.array(values, np.uint32).astype(np.int32)
      if before is not None:
        still = np.abs(counts - before) <= _REST_COUNTS
        if still.all():
          return np.clip(counts, 0, 4095).tolist()
        moving = [
          joint.name for joint, rest in zip(self._bus.wiring.joints, still, strict=True) if not rest
        ]
      before = counts
      self._bus.clock.sleep_until(self._bus.clock.now() + _REST_INTERVAL)
    raise BusError(f"These joints keep moving, so torque stays off: {', '.join(moving)}.")

  def torque(self, enabled: bool) -> bool:
    """Switches the torque of all servos; returns whether all confirmed it."""
    value = int(enabled)
    for _ in range(_ATTEMPTS):
      self._bus.write_all(TORQUE_ENABLE, 1, [value] * self._count)
      if self._bus.read_all(TORQUE_ENABLE, 1) == [value] * self._count:
        return True
    return False

  def torque_states(self) -> list[int | None]:
    """Returns the servos' torque enable [J]; None where a servo does not answer."""
    states = self._bus.read_all(TORQUE_ENABLE, 1, attempts=1)
    if states is not None:
      return list(states)
    found: list[int | None] = []
    for device in self._bus.wiring.ids:  # a dead servo silences those behind it in common answers
      try:
        found.append(self._bus.read(device, TORQUE_ENABLE, 1, attempts=1)[0])
      except BusError:
        found.append(None)
    return found

  def hardware_errors(self) -> dict[str, list[str]]:
    """Returns the names of the errors that servos report, by joint."""
    found = {}
    for joint in self._bus.wiring.joints:
      try:
        status = self._bus.read(joint.device, HARDWARE_ERROR, 1)[0]
      except BusError:
        continue
      if status:
        found[joint.name] = [name for bit, name in ERROR_BITS.items() if status & bit]
    return found

  def reboot(self, name: str) -> None:
    """Restarts the servo of a joint, which clears its hardware errors."""
    names = [joint.name for joint in self._bus.wiring.joints]
    self._bus.reboot(self._bus.wiring.ids[names.index(name)])
    self._bus.clock.sleep_until(self._bus.clock.now() + _BOOT_TIME)
