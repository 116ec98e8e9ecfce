"""The recorder's own process: reads messages from standard input and writes the MCAP file.

Started by `real.recorder.recorder.Recorder`; says "open" once the file is there.
"""

import pickle
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any, BinaryIO

import cv2
import numpy as np
from mcap_ros2.writer import Writer

from nerf2real.core.robot_logs import messages
from nerf2real.real.recorder.recorder import LENGTH

_CHUNK = 1 << 20  # bytes: chunks end by time before they are so large
_FLUSH_PERIOD = 0.25  # s between chunks: what a killed recorder loses; ours
_JPEG_QUALITY = 92
_NANO = 1_000_000_000


def nanoseconds(seconds: float) -> int:
  """Returns integer nanoseconds, rounded to what a double can hold."""
  whole = int(seconds)
  return whole * _NANO + round((seconds - whole) * _NANO)


def to_messages(kind: str, arguments: tuple[Any, ...]) -> Iterator[messages.Message]:
  """Turns what the recorder was told into messages."""
  time_ns = nanoseconds(arguments[0])
  rest = arguments[1:]
  if kind == "command":
    yield messages.joint_state(messages.COMMANDS, time_ns, rest[0], position=rest[1])
  elif kind == "joints":
    names, positions, velocities, currents, voltages, pwm, offsets = rest
    yield messages.joint_state(
      messages.STATES, time_ns, names, position=positions, velocity=velocities
    )
    # Not efforts: amperes, volts, shares and seconds travel in a JointState's effort, by topic.
    for topic, values in (
      (messages.CURRENTS, currents),
      (messages.VOLTAGES, voltages),
      (messages.PWM, pwm),
      (messages.STAMPS, offsets),
    ):
      if values is not None:
        yield messages.joint_state(topic, time_ns, names, effort=values)
  elif kind == "imu":
    yield messages.imu(time_ns, rest[0], rest[1])
    if rest[2] is not None:
      yield messages.gravity(time_ns, rest[2])
  elif kind == "image":
    yield messages.image(time_ns, _jpeg(rest[0]))
  elif kind == "camera_info":
    yield messages.camera_info(time_ns, rest[0])
  elif kind == "battery":
    yield messages.battery(time_ns, rest[0])
  elif kind == "temperature":
    yield messages.temperature(time_ns, *rest)
  else:
    raise ValueError(f"Unknown message kind {kind!r}.")


def _jpeg(picture: bytes | np.ndarray) -> bytes:
  if isinstance(picture, bytes):
    return picture
  done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
  if not done:
    raise ValueError(f"OpenCV cannot encode a picture of shape {picture.shape}.")
  return data.tobytes()


class LogFile:
  """An MCAP file that grows."""

  def __init__(self, stream: BinaryIO):
    self._stream = stream
    self._writer = Writer(stream, chunk_size=_CHUNK)
    self._schemas: dict[str, Any] = {}
    self._sequences: dict[str, int] = {}
    self._flushed = time.monotonic()

  def write(self, message: messages.Message) -> None:
    """Adds one message; its header's stamp is the log's time."""
    topic, kind, fields = message
    if kind not in self._schemas:
      self._schemas[kind] = self._writer.register_msgdef(kind, messages.DEFINITIONS[kind])
    stamp = fields["header"]["stamp"]
    time_ns = stamp["sec"] * _NANO + stamp["nanosec"]
    sequence = self._sequences.get(topic, 0)
    self._sequences[topic] = sequence + 1
    self._writer.write_message(
      topic, self._schemas[kind], fields, log_time=time_ns, publish_time=time_ns, sequence=sequence
    )
    if time.monotonic() - self._flushed > _FLUSH_PERIOD:
      self.flush()

  def flush(self) -> None:
    """Ends the chunk, so that what was written is readable."""
    self._writer._writer.flush()  # the ROS 2 writer does not pass it on
    self._stream.flush()
    self._flushed = time.monotonic()

  def finish(self) -> None:
    """Writes index and footer."""
    self._writer.finish()


def receive(pipe: BinaryIO) -> Iterator[tuple[str, tuple[Any, ...]]]:
  """Yields what comes through the pipe until it ends."""
  while True:
    head = pipe.read(LENGTH.size)
    if len(head) < LENGTH.size:
      return
    (size,) = LENGTH.unpack(head)
    data = pipe.read(size)
    if len(data) < size:
      return
    yield pickle.loads(data)


def main() -> None:
  """Writes until the pipe ends."""
  signal.signal(signal.SIGINT, signal.SIG_IGN)  # the pipe's end says when
  try:
    stream = open(sys.argv[1], "wb")  # noqa: SIM115  (closed below)
  except OSError as error:
    print(error, flush=True)
    sys.exit(1)
  with stream:
    log = LogFile(stream)
    print("open", flush=True)
    try:
      for kind, arguments in receive(sys.stdin.buffer):
        for message in to_messages(kind, arguments):
          log.write(message)
    finally:
      log.finish()


if __name__ == "__main__":
  main()
