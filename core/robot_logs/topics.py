"""Reads the topics of a measured log from its MCAP file: bytes to messages in the file's order."""

import dataclasses
import pathlib
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from nerf2real.core.robot_logs.messages import BATTERY, COMMANDS, IMU, PWM, STATES, TEMPERATURE_TYPE

__all__ = [
  "BATTERY",
  "COMMANDS",
  "IMU",
  "NANO",
  "PWM",
  "STATES",
  "TEMPERATURE_TYPE",
  "LogError",
  "Topic",
  "check_time",
  "read_topics",
]

NANO = 1e-9

# What the parsers of MCAP, of its two compressions and of ROS messages raise on damaged bytes.
_DAMAGE = (
  *(McapError, zstandard.ZstdError, struct.error, EOFError),
  *(ValueError, KeyError, IndexError, RuntimeError, MemoryError, OverflowError),
)


class LogError(ValueError):
  """A log that cannot be used: one line with what was found, what was expected, what to do."""


@dataclasses.dataclass
class Topic:
  """The decoded messages of one topic in the order of the file."""

  name: str
  schema: str
  stamp_ns: list[int] = dataclasses.field(default_factory=list)
  log_ns: list[int] = dataclasses.field(default_factory=list)
  messages: list[Any] = dataclasses.field(default_factory=list)


def read_topics(path: pathlib.Path, recover: bool) -> tuple[dict[str, Topic], bool]:
  """Reads the topics that measured logs are made of.

  Temperatures are found by type: the topic's name is free, frame_id names the joint.

  Args:
    path: an MCAP file.
    recover: return what is readable of a damaged file instead of raising.

  Returns:
    The topics with messages by name, and whether the file was damaged.
  """
  topics: dict[str, Topic] = {}
  decoders = DecoderFactory()
  known: dict[int, Callable[[bytes], Any] | None] = {}
  channels: dict[int, Channel] = {}
  schemas: dict[int, Schema] = {}
  try:
    with path.open("rb") as stream:
      for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Schema):
          schemas[record.id] = record
        elif isinstance(record, Channel):
          channels[record.id] = record
        elif isinstance(record, Message):
          channel = channels[record.channel_id]
          schema = schemas[channel.schema_id]
          if channel.id not in known:
            wanted = channel.topic in (COMMANDS, STATES, PWM, IMU, BATTERY)
            wanted = wanted or schema.name == TEMPERATURE_TYPE
            known[channel.id] = (
              decoders.decoder_for(channel.message_encoding, schema) if wanted else None
            )
          decode = known[channel.id]
          if decode is not None:
            topic = topics.setdefault(channel.topic, Topic(channel.topic, schema.name))
            _append(topic, record, decode(record.data))
  except _DAMAGE as error:
    if not recover:
      raise LogError(_damage(path, error, topics)) from error
    return topics, True
  return topics, False


def _append(topic: Topic, record: Message, message: Any) -> None:
  stamp = message.header.stamp
  # A driver that leaves the stamp empty means: the moment of writing.
  stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec or record.log_time
  topic.stamp_ns.append(stamp_ns)
  topic.log_ns.append(record.log_time)
  topic.messages.append(message)


def _damage(path: pathlib.Path, error: Exception, topics: dict[str, Topic]) -> str:
  """Returns the message for a file that cannot be read to its end."""
  with path.open("rb") as stream:
    head = stream.read(5)
  if not head:
    return f"{path.name} is empty, expected an MCAP file: record it again."
  if not b"\x89MCAP".startswith(head):
    return f"{path.name} is not an MCAP file: it starts with {head!r}, expected b'\\x89MCAP'."
  count = sum(len(topic.messages) for topic in topics.values())
  reason = str(error).splitlines()[0] if str(error) else type(error).__name__
  return (
    f"{path.name} is truncated or damaged ({reason}): {count} messages are readable; copy it "
    "again, or read what is there with recover=True."
  )


def check_time(name: str, topic: Topic) -> None:
  """Raises a LogError where the stamps or log times of a topic of file `name` decrease."""
  for which, times in (("header stamps", topic.stamp_ns), ("log times", topic.log_ns)):
    steps = np.diff(np.array(times, dtype=np.int64))
    if np.any(steps < 0):
      at = int(np.argmax(steps < 0))
      raise LogError(
        f"{name}: time runs backwards on {topic.name} by {-steps[at] * NANO:.6g} s at message "
        f"{at + 1} ({which}), {np.count_nonzero(steps < 0)} times in all; expected increasing "
        "stamps: record with one monotonic clock."
      )
