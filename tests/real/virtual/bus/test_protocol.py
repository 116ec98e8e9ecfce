"""Tests of the packets against the e-Manual's examples and against the DYNAMIXEL SDK."""

import dynamixel_sdk
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from nerf2real.real.virtual.bus import protocol
from nerf2real.real.virtual.bus.protocol import Instruction
from nerf2real.real.wire.packets import PacketHandler

_SDK = dynamixel_sdk.Protocol2PacketHandler()


@pytest.mark.parametrize(
  "made, printed",
  [  # e-Manual, Protocol 2.0, examples of ping, read and write
    (protocol.packet(1, Instruction.PING), "fffffd0001030001 194e"),
    (protocol.packet(0xFE, Instruction.PING), "fffffd00fe030001 3142"),
    (protocol.packet(1, Instruction.READ, bytes((0x84, 0, 4, 0))), "fffffd000107000284000400 1d15"),
    (
      protocol.packet(1, Instruction.WRITE, bytes((0x74, 0, 0, 2, 0, 0))),
      "fffffd00010900037400000200 00 ca89",
    ),
    (protocol.status(1, 0, bytes((6, 4, 0x26))), "fffffd000107005500060426 655d"),
    (protocol.status(2, 0, bytes((6, 4, 0x26))), "fffffd000207005500060426 6f6d"),
    (protocol.status(1, 0, bytes((0xA6, 0, 0, 0))), "fffffd000108005500a6000000 8cc0"),
  ],
)
def test_packets_are_those_of_the_manual(made, printed):
  assert made == bytes.fromhex(printed)


@given(st.binary(max_size=300))
def test_crc_is_the_sdks(data):
  assert protocol.crc16(data) == _SDK.updateCRC(0, data, len(data))


def test_crc_goes_on_where_it_stopped():
  data = bytes(range(100))
  assert protocol.crc16(data[40:], protocol.crc16(data[:40])) == protocol.crc16(data)


def _plain(data):
  """A status packet of device 7 before stuffing, as the SDK's functions take it."""
  length = len(data) + 4
  return [
    0xFF,
    0xFF,
    0xFD,
    0,
    7,
    length & 0xFF,
    length >> 8,
    Instruction.STATUS,
    0,
    *data,
    0xAB,
    0xCD,
  ]


_MANY_HEADERS = st.lists(st.sampled_from([0xFF, 0xFD, 0xFE, 0x00, 0x07]), max_size=40).map(bytes)


@given(_MANY_HEADERS)
@example(bytes.fromhex("fffffdfffdfd"))
def test_stuffing_is_the_sdks(data):
  assert list(protocol.status(7, 0, data))[:-2] == _SDK.addStuffing(_plain(data))[:-2]


@given(_MANY_HEADERS)
@example(bytes.fromhex("fffffdfffdfd"))
def test_the_host_removes_the_sdks_stuffing(data):
  found = PacketHandler().removeStuffing(_SDK.addStuffing(_plain(data)))
  assert found[: 11 + len(data)] == _plain(data)


@given(_MANY_HEADERS)
def test_the_sdks_removal_agrees_where_it_is_right(data):
  """The reason for the own removal is that the SDK's is wrong, not another rule."""
  stuffed = _SDK.addStuffing(_plain(data))
  theirs = _SDK.removeStuffing(list(stuffed))[: 11 + len(data)]
  if theirs == _plain(data):
    assert PacketHandler().removeStuffing(list(stuffed))[: 11 + len(data)] == theirs
  else:
    assert b"\xff\xff\xfd" in data


def test_the_sdks_removal_is_still_wrong():
  """If this fails: the SDK is mended, and `real/wire/packets.py` has no use any more."""
  plain = _plain(bytes.fromhex("fffffdfffdfd"))
  assert _SDK.removeStuffing(_SDK.addStuffing(plain))[: len(plain)] != plain


@given(_MANY_HEADERS)
def test_stuffed_packets_hold_no_second_header(data):
  assert protocol.status(7, 0, data)[:-2].find(b"\xff\xff\xfd\x00", 1) < 0


@given(
  st.lists(
    st.tuples(st.integers(0, 252), st.sampled_from(list(Instruction)), st.binary(max_size=30)),
    max_size=5,
  ),
  st.integers(1, 40),
)
def test_packets_are_found_however_the_stream_is_cut(packets, cut):
  stream = b"\x00\xff\xff" + b"\xff\x12".join(protocol.packet(*each) for each in packets)
  parser = protocol.Parser()
  found = []
  for start in range(0, len(stream), cut):
    found += parser.feed(stream[start : start + cut])
  assert [(p.device, p.instruction, p.parameters) for p in found] == packets
  assert all(p.intact for p in found)


def test_a_flipped_bit_is_noticed():
  good = protocol.packet(3, Instruction.WRITE, b"\x74\x00\x01\x02\x03\x04")
  for place in range(7, len(good)):
    bad = bytearray(good)
    bad[place] ^= 0x10
    assert not any(p.intact for p in protocol.Parser().feed(bytes(bad)))


def test_a_fast_answer_carries_a_running_crc():
  data, ends = protocol.fast_status([(3, 0, b"\xa6\x00\x00\x00"), (7, 0x80, b"\x1f\x08\x00\x00")])
  assert ends == [16, 24] and len(data) == 24
  assert data[5] | data[6] << 8 == len(data) - 7
  for end in ends:
    assert protocol.crc16(data[: end - 2]) == data[end - 2] | data[end - 1] << 8
