"""The recorder's own process: reads messages to build from standard input, writes the MCAP file.

Started by `real.recorder.recorder.Recorder`; sends "open" once the file is there.
"""

import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from nerf2real.core.files import explain_disk_full
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import LogWriter
from nerf2real.real.recorder.recorder import LENGTH, OPEN, Call

_CHUNK = 1 << 20  # bytes: chunks end by time before they are so large
_FLUSH_PERIOD = 0.25  # s between chunks; chosen: what a killed recorder loses
_JPEG_QUALITY = 92


def nanoseconds(seconds: float) -> int:
  """Returns integer nanoseconds, rounded to what a double can hold."""
  whole = int(seconds)
  return whole * messages.SECOND + round((seconds - whole) * messages.SECOND)


def image(time_ns: int, picture: np.ndarray) -> messages.Message:
  """Returns a picture, RGB uint8 [H, W, 3], as a message."""
  done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
  if not done:
    raise ValueError(f"OpenCV cannot encode a picture of shape {picture.shape}.")
  return messages.image(time_ns, data.tobytes())


BUILDERS: dict[str, Callable[..., messages.Message]] = {
  "joint_state": messages.joint_state,
  "imu": messages.imu,
  "gravity": messages.gravity,
  "image": image,
  "camera_info": messages.camera_info,
  "battery": messages.battery,
  "temperature": messages.temperature,
}


def receive(pipe: BinaryIO) -> Iterator[Call]:
  """Yields what comes through the pipe until it ends."""
  while True:
    head = pipe.read(LENGTH.size)
    if len(head) < LENGTH.size:
      return
    (size,) = LENGTH.unpack(head)
    data = pipe.read(size)
    if len(data) < size:
      return
    yield from pickle.loads(data)


def main() -> None:
  """Writes until the pipe ends."""
  signal.signal(signal.SIGINT, signal.SIG_IGN)  # until the pipe's end
  try:
    with explain_disk_full(sys.argv[1]):
      _record(Path(sys.argv[1]))
  except OSError as error:  # the reason, for the recorder; a trace would end in the terminal
    print(error, flush=True)
    sys.exit(1)


def _record(path: Path) -> None:
  with path.open("wb") as stream:
    log = LogWriter(stream, chunk_size=_CHUNK, flush_period=_FLUSH_PERIOD)
    print(OPEN, flush=True)
    try:
      for name, seconds, arguments, fields in receive(sys.stdin.buffer):
        log.write(BUILDERS[name](nanoseconds(seconds), *arguments, **fields))
    finally:
      log.finish()


if __name__ == "__main__":
  main()
