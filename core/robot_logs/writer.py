"""Writes robot logs: MCAP files with ROS 2 messages, without ROS."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from mcap_ros2.writer import Writer

from nerf2real.core import files
from nerf2real.core.robot_logs import messages

CHUNK_SIZE = 64 * 1024
"""Bytes before compression; chosen: what a power cut may lose, a second of 20 joints."""


class LogWriter:
  """A log being written. Messages must come in the order of time within a topic."""

  def __init__(
    self, stream: BinaryIO, *, chunk_size: int = CHUNK_SIZE, flush_period: float | None = None
  ):
    """Writes the head of the file.

    Args:
      stream: The file.
      chunk_size: Bytes of messages that are compressed together.
      flush_period: s after which a chunk ends though it is not full, so that what was written can
        be read; None: chunks end when they are full.
    """
    self._stream, self._flush_period = stream, flush_period
    self._writer = Writer(stream, chunk_size=chunk_size)
    self._schemas: dict[str, Any] = {}
    self._sequences: dict[str, int] = {}
    self._flushed = time.monotonic()

  def write(self, message: messages.Message, *, log_ns: int | None = None) -> None:
    """Adds one message.

    Args:
      message: From `core.robot_logs.messages`.
      log_ns: When it was written down, ns since 1970; the header's stamp if None.
    """
    topic, kind, fields = message
    if kind not in self._schemas:
      self._schemas[kind] = self._writer.register_msgdef(kind, messages.definition(kind))
    if log_ns is None:
      stamp = fields["header"]["stamp"]
      log_ns = stamp["sec"] * messages.SECOND + stamp["nanosec"]
    sequence = self._sequences.get(topic, 0)
    self._sequences[topic] = sequence + 1
    self._writer.write_message(
      topic, self._schemas[kind], fields, log_time=log_ns, publish_time=log_ns, sequence=sequence
    )
    if self._flush_period is not None and time.monotonic() - self._flushed > self._flush_period:
      self.flush()

  def flush(self) -> None:
    """Ends the chunk, so that what was written is readable."""
    self._writer._writer.flush()  # the ROS 2 writer does not pass it on
    self._stream.flush()
    self._flushed = time.monotonic()

  def finish(self) -> None:
    """Writes index and footer."""
    self._writer.finish()


@contextlib.contextmanager
def open_log(path: str | Path) -> Iterator[LogWriter]:
  """Opens a log for writing, its folder is made; the file appears, complete, at the context's end.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
  """
  path = Path(path)
  path.parent.mkdir(parents=True, exist_ok=True)
  with files.atomic_path(path) as partial, partial.open("wb") as stream:
    writer = LogWriter(stream)
    yield writer
    writer.finish()
