"""The packet handler of the DYNAMIXEL SDK with byte stuffing removed as Protocol 2.0 defines it.

The SDK (4.1) removes it in place and compares with bytes that it has already moved: FF FF FD FF FD
FD in an answer loses its last byte.
"""

import dynamixel_sdk

_BODY = 7  # place of the first byte after the length
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"


class PacketHandler(dynamixel_sdk.Protocol2PacketHandler):
  """A `dynamixel_sdk.Protocol2PacketHandler`."""

  def removeStuffing(self, packet: list[int]) -> list[int]:
    """Removes the stuffing of a received packet in place and returns it."""
    end = _BODY + (packet[5] | packet[6] << 8) - 2
    crc = packet[end : end + 2]
    body = bytes(packet[_BODY:end]).replace(_STUFFED, _PLAIN)
    packet[_BODY : _BODY + len(body) + 2] = [*body, *crc]
    packet[5], packet[6] = (len(body) + 2) & 0xFF, (len(body) + 2) >> 8
    return packet
