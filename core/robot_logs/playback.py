"""Reads a recorded log message by message, also one whose recorder was killed.

For identification `core.robot_logs.reading` reads joints and IMU into arrays; this gives every
topic, pictures included, in the order of the file.
"""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

_NANO = 1e-9
# What the parsers raise where a file ends in the middle of a record.
_CUT = (McapError, zstandard.ZstdError, struct.error, EOFError)
_MAGIC = b"\x89MCAP"


class Reading(NamedTuple):
  """One message of a log."""

  topic: str
  time: float  # of the header's stamp, s since 1970
  message: Any  # fields as in ROS 2


def read_messages(path: Path | str) -> Iterator[Reading]:
  """Yields the messages of a log in the order of the file, up to where it was cut off.

  Raises:
    ValueError: The file is not an MCAP.
    FileNotFoundError: There is no such file.
  """
  path = Path(path)
  with path.open("rb") as stream:
    head = stream.read(len(_MAGIC))
    if head != _MAGIC:
      raise ValueError(f"{path} is not an MCAP file: it starts with {head!r}, expected {_MAGIC!r}.")
    stream.seek(0)
    decoders, decode = DecoderFactory(), {}
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    records = StreamReader(stream, validate_crcs=True).records
    while True:
      try:
        record = next(records)
      except (StopIteration, *_CUT):
        return
      if isinstance(record, Schema):
        schemas[record.id] = record
      elif isinstance(record, Channel):
        channels[record.id] = record
        decode[record.id] = _decoder(decoders, record, schemas[record.schema_id])
      elif isinstance(record, Message):
        message = decode[record.channel_id](record.data)
        stamp = message.header.stamp
        yield Reading(channels[record.channel_id].topic, stamp.sec + stamp.nanosec * _NANO, message)


def _decoder(factory: DecoderFactory, channel: Channel, schema: Schema) -> Callable[[bytes], Any]:
  decoder = factory.decoder_for(channel.message_encoding, schema)
  if decoder is None:
    raise ValueError(
      f"Found {channel.topic} in the encoding {channel.message_encoding!r} of {schema.encoding!r}, "
      "expected ROS 2 messages (cdr)."
    )
  return decoder


def is_complete(path: Path | str) -> bool:
  """Returns whether a log was closed properly: it ends with MCAP's magic bytes."""
  with Path(path).open("rb") as stream:
    stream.seek(0, 2)
    if stream.tell() < 2 * len(_MAGIC):
      return False
    stream.seek(-8, 2)  # the closing magic has 8 bytes
    return stream.read(len(_MAGIC)) == _MAGIC
