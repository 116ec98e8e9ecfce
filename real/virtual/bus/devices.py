"""All devices on the virtual robot's bus: an instruction goes in, timed answers come out.

Time on the wire is part of it: a byte takes 10 bits at 2 Mbps, an answer waits for the return delay
time, and each device is sampled when its own part of an answer begins, so the joints of one reading
belong to different moments. In sync and bulk reads a device answers after the one before it; if
that one is silent, so are all that follow.
"""

from typing import NamedTuple

import numpy as np

from nerf2real.real.virtual.body import Body
from nerf2real.real.virtual.bus import protocol
from nerf2real.real.virtual.bus.board import Board
from nerf2real.real.virtual.bus.faults import Faults
from nerf2real.real.virtual.bus.protocol import ALERT, BROADCAST, Error, Instruction, Packet
from nerf2real.real.virtual.bus.servo import Servo
from nerf2real.suite.op3 import constants

BAUD = 2_000_000  # bit/s
BYTE_TIME = protocol.BITS_PER_BYTE / BAUD  # s
_FAST_HEAD = 8  # bytes of a fast answer before its first part
_PROTECT_PERIOD = 0.010  # s between a servo's checks of temperature and voltage: chosen

# Ids by joint: ROBOTIS OP3, odd right, even left. The virtual robot's own copy: what the host
# expects (real.wire.op3) is tested against it.
IDS = {
  "r_sho_pitch": 1,
  "l_sho_pitch": 2,
  "r_sho_roll": 3,
  "l_sho_roll": 4,
  "r_el": 5,
  "l_el": 6,
  "r_hip_yaw": 7,
  "l_hip_yaw": 8,
  "r_hip_roll": 9,
  "l_hip_roll": 10,
  "r_hip_pitch": 11,
  "l_hip_pitch": 12,
  "r_knee": 13,
  "l_knee": 14,
  "r_ank_pitch": 15,
  "l_ank_pitch": 16,
  "r_ank_roll": 17,
  "l_ank_roll": 18,
  "head_pan": 19,
  "head_tilt": 20,
}


Wanted = list[tuple[int, int, int]]  # (id, address, length) in the order of sending


class Answer(NamedTuple):
  """Bytes that a device sends."""

  time: float  # s, when their last bit is on the wire
  data: bytes


class Devices:
  """The servos and the board of one robot."""

  def __init__(self, body: Body, *, faults: Faults, seed: int = 0, noise: int = 0):
    """Connects the devices to a body.

    Args:
      body: The plant.
      faults: What goes wrong; may change at any time.
      seed: Seed of noise and of the faults' chances.
      noise: Which of the seed's noises; see `VirtualRobot`.
    """
    self.body, self.faults = body, faults
    self._rng = np.random.default_rng([seed, 6, noise])
    self.servos = {
      IDS[name]: Servo(IDS[name], index, body.motors)
      for index, name in enumerate(constants.JOINT_NAMES)
    }
    deviations = np.repeat([body.hidden.gyroscope_noise, body.hidden.accelerometer_noise], 3)
    self.board = Board(deviations, np.random.default_rng([seed, 7, noise]))
    self._all: dict[int, Servo | Board] = {**self.servos, self.board.device: self.board}
    self._ids = np.array([IDS[name] for name in constants.JOINT_NAMES])
    self._powered = False
    self._next_check = body.time
    body.after_step = self._after_step

  def handle(self, packet: Packet, time: float) -> list[Answer]:
    """Takes an instruction whose last bit arrived at a time [s]; returns the answers."""
    with self.body.lock:
      self.body.advance(time)
      if not packet.intact:
        return self._refuse(packet, time)
      for servo in self.servos.values():
        servo.hear(time)
      answers = self._answer(packet, time)
    faults, rng = self.faults, self._rng
    return [
      Answer(answer.time + faults.delay(rng), faults.damage(answer.data, rng))
      for answer in answers
      if faults.arrives(rng)
    ]

  def hears(self, data: bytes) -> bytes:
    """Returns what arrives of an instruction's bytes."""
    return self.faults.damage(data, self._rng) if self.faults.arrives(self._rng) else b""

  def _answer(self, packet: Packet, time: float) -> list[Answer]:
    parameters = packet.parameters
    match packet.instruction:
      case Instruction.PING:
        return self._ping(packet.device, time)
      case Instruction.SYNC_WRITE:
        self._sync_write(parameters, time)
        return []
      case Instruction.BULK_WRITE:
        self._bulk_write(parameters, time)
        return []
      case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
        address, length = _words(parameters[:4])
        wanted = [(device, address, length) for device in parameters[4:]]
        fast = packet.instruction == Instruction.FAST_SYNC_READ
        return self._read_fast(wanted, time) if fast else self._read_each(wanted, time)
      case Instruction.BULK_READ | Instruction.FAST_BULK_READ:
        rows = [parameters[i : i + 5] for i in range(0, len(parameters) - 4, 5)]
        wanted = [(row[0], row[1] | row[2] << 8, row[3] | row[4] << 8) for row in rows]
        fast = packet.instruction == Instruction.FAST_BULK_READ
        return self._read_fast(wanted, time) if fast else self._read_each(wanted, time)
    found = []
    for device in self._addressed(packet.device, time):
      error, data, answered = self._do(device, packet.instruction, parameters, time)
      if answered and packet.device != BROADCAST:
        found.append(self._status(device, error, data, time))
    return found

  def _do(self, device: Servo | Board, instruction: int, parameters: bytes, time: float):
    """Returns (error number, data, whether it is answered) of an instruction to one device."""
    if instruction == Instruction.READ and len(parameters) == 4:
      address, length = _words(parameters)
      error, data = device.read(address, length, time)
      return error, data, True
    if instruction == Instruction.WRITE and len(parameters) > 2:
      address = _words(parameters[:2])[0]
      return device.write(address, parameters[2:], time), b"", device.answers
    if isinstance(device, Servo):
      if instruction == Instruction.REG_WRITE and len(parameters) > 2:
        address = _words(parameters[:2])[0]
        return device.register_write(address, parameters[2:]), b"", device.answers
      if instruction == Instruction.ACTION:
        return device.action(time), b"", device.answers
      if instruction == Instruction.REBOOT:
        device.boot(time)
        return Error.NONE, b"", device.answers
    return Error.INSTRUCTION, b"", True

  def _ping(self, target: int, time: float) -> list[Answer]:
    found = []
    for device in self._addressed(target, time):
      number, firmware = device.table["model_number"], device.table["firmware_version"]
      data = number.to_bytes(2, "little") + bytes((firmware,))
      answer = self._status(device, Error.NONE, data, time)
      time = answer.time
      found.append(answer)
    return found

  def _read_each(self, wanted: Wanted, time: float) -> list[Answer]:
    """Answers a sync or bulk read: one status packet a device, one after another."""
    answers = []
    for device_id, address, length in wanted:
      device = self._reachable(device_id, time)
      if device is None:  # the next one waits for it in vain
        break
      time += device.table.return_delay
      self.body.advance(time)
      error, data = device.read(address, length, time)
      packet = protocol.status(device_id, error | self._alert(device), data)
      time += BYTE_TIME * len(packet)
      answers.append(Answer(time, packet))
    return answers

  def _read_fast(self, wanted: Wanted, time: float) -> list[Answer]:
    """Answers a fast sync or bulk read: one status packet, to which every device adds its part."""
    parts: list[tuple[int, int, bytes]] = []
    spoken = 0
    for device_id, address, length in wanted:
      device = self._reachable(device_id, time)
      # The board's firmware has no fast reads.
      if spoken < len(parts) or not isinstance(device, Servo):
        parts.append((device_id, 0, bytes(length)))  # its place in the packet stays silent
        continue
      if not parts:
        time += device.table.return_delay + _FAST_HEAD * BYTE_TIME
      self.body.advance(time)
      error, data = device.read(address, length, time)
      parts.append((device_id, error | self._alert(device), data.ljust(length, b"\0")))
      spoken += 1
      time += BYTE_TIME * (length + 4)
    if not spoken:
      return []
    data, ends = protocol.fast_status(parts)
    return [Answer(time, data[: ends[spoken - 1]])]

  def _sync_write(self, parameters: bytes, time: float) -> None:
    address, length = _words(parameters[:4])
    step = length + 1
    for i in range(4, len(parameters) - length, step):
      self._write_silently(parameters[i], address, parameters[i + 1 : i + step], time)

  def _bulk_write(self, parameters: bytes, time: float) -> None:
    i = 0
    while i + 5 <= len(parameters):
      address, length = _words(parameters[i + 1 : i + 5])
      data = parameters[i + 5 : i + 5 + length]
      self._write_silently(parameters[i], address, data, time)
      i += 5 + length

  def _write_silently(self, device_id: int, address: int, data: bytes, time: float) -> None:
    device = self._reachable(device_id, time)
    if device is not None:
      device.write(address, data, time)

  def _refuse(self, packet: Packet, time: float) -> list[Answer]:
    """Answers a damaged instruction to one device."""
    device = self._reachable(packet.device, time)
    return [] if device is None else [self._status(device, Error.CRC, b"", time)]

  def _addressed(self, target: int, time: float) -> list[Servo | Board]:
    if target == BROADCAST:
      ordered = [self._all[device_id] for device_id in sorted(self._all)]
      return [device for device in ordered if self._hears(device, time)]
    device = self._reachable(target, time)
    return [] if device is None else [device]

  def _reachable(self, device_id: int, time: float) -> Servo | Board | None:
    device = self._all.get(device_id)
    return device if device is not None and self._hears(device, time) else None

  def _hears(self, device: Servo | Board, time: float) -> bool:
    if isinstance(device, Board):
      return True
    return self._powered and device.device not in self.faults.dead and device.awake(time)

  def _status(self, device: Servo | Board, error: int, data: bytes, time: float) -> Answer:
    packet = protocol.status(device.device, error | self._alert(device), data)
    return Answer(time + device.table.return_delay + BYTE_TIME * len(packet), packet)

  def _alert(self, device: Servo | Board) -> int:
    return ALERT if device.alert else 0

  # ---- what goes on without the bus ----

  def _after_step(self, time: float) -> None:
    body, motors = self.body, self.body.motors
    self.board.sense(time, body.imu, motors.supply)
    if time < self._next_check:
      return
    self._next_check = time + _PROTECT_PERIOD
    faults = self.faults
    motors.forced_voltage = faults.voltage
    motors.stuck, motors.is_stuck = np.isin(self._ids, list(faults.stuck)), bool(faults.stuck)
    for device_id, degrees in faults.heat.items():
      motors.temperature[self._ids == device_id] = degrees
    for device_id in faults.dead:
      motors.enabled[self._ids == device_id] = False
    powered = self.board.powers and not motors.browned_out
    for servo in self.servos.values():
      if powered != self._powered:
        servo.boot(time)
      elif powered:
        servo.protect(time)
    self._powered = powered


def _words(data: bytes) -> list[int]:
  """Returns the little-endian 16-bit words of some bytes."""
  return [data[i] | data[i + 1] << 8 for i in range(0, len(data) - 1, 2)]
