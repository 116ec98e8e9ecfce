"""Reads a robot log's messages in the order of its file, also of a file whose recorder was killed.

MCAP is read record by record, without its index: a file without a footer gives every message up to
where it ends.
"""

import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

NANO = 1e-9
_MAGIC = b"\x89MCAP"
_MAGIC_SIZE = 8  # bytes, of the whole one at the file's start and end
# What the parsers of MCAP, of its two compressions and of ROS messages raise on damaged bytes.
_DAMAGE = (
  *(McapError, zstandard.ZstdError, struct.error, EOFError),
  *(ValueError, KeyError, IndexError, RuntimeError, MemoryError, OverflowError),
)


class LogError(ValueError):
  """A log that cannot be used: one line with what was found, what was expected, what to do."""


class DamagedLogError(LogError):
  """A log that cannot be read to its end."""


class Reading(NamedTuple):
  """One message of a log."""

  topic: str
  schema: str  # name of the message's type
  stamp_ns: int  # of the header, ns since 1970; the time of writing where the header has none
  log_ns: int  # when it was written down
  message: Any  # fields as in ROS 2

  @property
  def time(self) -> float:
    """The stamp [s] since 1970."""
    seconds, nanoseconds = divmod(self.stamp_ns, 1_000_000_000)
    return seconds + nanoseconds * NANO


def read_messages(
  path: Path | str,
  *,
  topics: Collection[str] | None = None,
  schemas: Collection[str] = (),
  recover: bool = False,
) -> Iterator[Reading]:
  """Yields the messages of a log in the order of the file.

  Args:
    path: An MCAP file with ROS 2 messages.
    topics: Topics that are decoded; None: all.
    schemas: Message types that are decoded whatever their topic is called.
    recover: Ends quietly where the file is cut off or damaged.

  Raises:
    DamagedLogError: The file ends in the middle or its bytes were changed, unless `recover`; all
      that is readable was yielded before.
    LogError: The file is no MCAP, or a topic's messages are not those of ROS 2.
    FileNotFoundError: There is no such file.
  """
  path = Path(path)
  count = 0
  try:
    with path.open("rb") as stream:
      for reading in _readings(path.name, stream, topics, schemas):
        yield reading
        count += 1
  except LogError:
    raise
  except _DAMAGE as error:
    with path.open("rb") as stream:
      head = stream.read(len(_MAGIC))
    if not head:
      raise LogError(f"{path.name} is empty, expected an MCAP file: record it again.") from error
    if not _MAGIC.startswith(head):
      raise LogError(
        f"{path.name} is not an MCAP file: it starts with {head!r}, expected {_MAGIC!r}."
      ) from error
    if not recover:
      reason = str(error).splitlines()[0] if str(error) else type(error).__name__
      raise DamagedLogError(
        f"{path.name} is truncated or damaged ({reason}): {count} messages are readable; copy it "
        "again, or save what is readable with `mcap recover` (in Python: recover=True)."
      ) from error


def _readings(
  name: str, stream: Any, topics: Collection[str] | None, schemas: Collection[str]
) -> Iterator[Reading]:
  factory = DecoderFactory()
  types: dict[int, Schema] = {}
  decoders: dict[int, tuple[str, str, Callable[[bytes], Any]]] = {}  # of the selected channels
  for record in StreamReader(stream, validate_crcs=True).records:
    if isinstance(record, Message):
      if record.channel_id not in decoders:
        continue
      topic, schema, decode = decoders[record.channel_id]
      message = decode(record.data)
      stamp = message.header.stamp
      # A driver that leaves the stamp empty means: the moment of writing.
      stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec or record.log_time
      yield Reading(topic, schema, stamp_ns, record.log_time, message)
    elif isinstance(record, Schema):
      types[record.id] = record
    elif isinstance(record, Channel):
      kind = types.get(record.schema_id)  # None: a topic without a schema, such as of JSON
      chosen = kind is not None and kind.name in schemas
      if topics is not None and record.topic not in topics and not chosen:
        continue
      decoder = factory.decoder_for(record.message_encoding, kind)
      if kind is None or decoder is None:
        raise LogError(
          f"{name} has {record.topic} in the encoding {record.message_encoding!r} of "
          f"{kind.encoding if kind else None!r}, expected ROS 2 messages (cdr): record that topic "
          "with ROS 2."
        )
      decoders[record.id] = (record.topic, kind.name, decoder)


def is_complete(path: Path | str) -> bool:
  """Returns whether a log was closed properly: it ends with MCAP's magic bytes."""
  with Path(path).open("rb") as stream:
    stream.seek(0, 2)
    if stream.tell() < 2 * _MAGIC_SIZE:
      return False
    stream.seek(-_MAGIC_SIZE, 2)
    return stream.read(len(_MAGIC)) == _MAGIC
