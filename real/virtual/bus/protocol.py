"""Dynamixel Protocol 2.0 of a device: packets, CRC, byte stuffing.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0" (packet layout, instructions, error numbers,
order of stuffing and CRC). The layout of fast reads is the one that the DYNAMIXEL SDK 4.1 decodes.

A packet is FF FF FD 00, id, length (2 bytes, low first), instruction, parameters, CRC (2 bytes, low
first). `length` counts from the instruction to the CRC.
"""

import enum
import struct
from collections.abc import Iterator
from typing import NamedTuple

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_LENGTH = 1024  # of a packet's length field; longer ones are taken for noise
BITS_PER_BYTE = 10  # 8 data bits, start and stop bit
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_POLYNOMIAL = 0x8005  # CRC-16 with initial value 0, most significant bit first


class Instruction(enum.IntEnum):
  """A packet's instruction."""

  PING = 0x01
  READ = 0x02
  WRITE = 0x03
  REG_WRITE = 0x04
  ACTION = 0x05
  REBOOT = 0x08
  STATUS = 0x55
  SYNC_READ = 0x82
  SYNC_WRITE = 0x83
  FAST_SYNC_READ = 0x8A
  BULK_READ = 0x92
  BULK_WRITE = 0x93
  FAST_BULK_READ = 0x9A


class Error(enum.IntEnum):
  """Error number of a status packet (bits 0 to 6)."""

  NONE = 0
  RESULT = 1
  INSTRUCTION = 2
  CRC = 3
  RANGE = 4
  LENGTH = 5
  LIMIT = 6
  ACCESS = 7


ALERT = 0x80  # bit 7 of a status packet's error: the hardware error status is not zero


class Packet(NamedTuple):
  """A packet that was received."""

  device: int  # id
  instruction: int
  parameters: bytes  # without stuffing
  size: int  # bytes on the wire, for its duration
  intact: bool  # the CRC fits


def _crc_table() -> tuple[int, ...]:
  table = []
  for byte in range(256):
    value = byte << 8
    for _ in range(8):
      value = (value << 1) ^ (_POLYNOMIAL if value & 0x8000 else 0)
    table.append(value & 0xFFFF)
  return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes | bytearray, start: int = 0) -> int:
  """Returns the CRC of bytes, going on from the CRC `start` of what came before."""
  crc, table = start, _CRC
  for byte in data:
    crc = ((crc << 8) & 0xFFFF) ^ table[(crc >> 8) ^ byte]
  return crc


def packet(device: int, instruction: int, parameters: bytes = b"") -> bytes:
  """Returns a packet: byte stuffing first, then the length, then the CRC."""
  body = (bytes((instruction,)) + parameters).replace(_PLAIN, _STUFFED)
  head = HEADER + struct.pack("<BH", device, len(body) + 2) + body
  return head + struct.pack("<H", crc16(head))


def status(device: int, error: int, data: bytes = b"") -> bytes:
  """Returns a status packet."""
  return packet(device, Instruction.STATUS, bytes((error,)) + data)


def fast_status(answers: list[tuple[int, int, bytes]]) -> tuple[bytes, list[int]]:
  """Returns the one status packet that several devices send together, and where each part ends.

  Every device adds error, id, data and the CRC of all that was sent up to there; the packet is not
  stuffed.

  Args:
    answers: (id, error, data) in the order of sending.
  """
  size = 1 + sum(4 + len(data) for _, _, data in answers)
  found = bytearray(HEADER + struct.pack("<BHB", BROADCAST, size, Instruction.STATUS))
  crc, ends = crc16(found), []
  for device, error, data in answers:
    part = bytes((error, device)) + data
    crc = crc16(part, crc)
    mark = struct.pack("<H", crc)
    crc = crc16(mark, crc)
    found += part + mark
    ends.append(len(found))
  return bytes(found), ends


class Parser:
  """Finds packets in a stream of bytes; noise between them is skipped."""

  def __init__(self) -> None:
    self._buffer = bytearray()

  def feed(self, data: bytes) -> Iterator[Packet]:
    """Takes bytes and yields the packets that they complete."""
    buffer = self._buffer
    buffer += data
    while True:
      start = buffer.find(HEADER)
      if start < 0:
        del buffer[: max(0, len(buffer) - len(HEADER) + 1)]
        return
      del buffer[:start]
      if len(buffer) < 8:
        return
      length = buffer[5] | buffer[6] << 8
      if not 3 <= length <= MAX_LENGTH:
        del buffer[:1]
        continue
      size = 7 + length
      if len(buffer) < size:
        return
      raw = bytes(buffer[:size])
      del buffer[:size]
      intact = crc16(raw[:-2]) == raw[-2] | raw[-1] << 8
      body = raw[8:-2].replace(_STUFFED, _PLAIN)
      yield Packet(raw[4], raw[7], body, size, intact)
