"""Pictures of a measured log and the lens that took them: read from the file again, one at a time.

A log of 16 s holds hundreds of pictures, so none is kept: they are decoded grey, at a fraction of
their size, as somebody asks for the next.

Shapes: H height, W width.
"""

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.robot_logs.messages import CAMERA_INFO, IMAGE
from nerf2real.core.robot_logs.streaming import NANO, Reading, read_messages

_WIDTH = 320  # pixel: pictures at least twice as wide are decoded at a half, a quarter, an eighth
_REDUCED = {
  1: cv2.IMREAD_GRAYSCALE,
  2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
  4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
  8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}
_MODELS = ("plumb_bob", "")  # of distortion that core.geometry.cameras has: k1, k2, p1, p2
_ASPECT = 0.01  # relative: pictures that are wider or less wide than the lens says were cropped


class LensError(ValueError):
  """Pictures that cannot be used: one line with what was found and what to do."""


@dataclasses.dataclass(frozen=True)
class Source:
  """Where a log's pictures are, and their lens."""

  path: pathlib.Path
  start_ns: int
  """Zero of the log's times."""
  lens: Camera
  """At the size of the decoded pictures."""
  reduction: int
  frame: str
  """frame_id of the pictures."""


def source(path: pathlib.Path, start_ns: int) -> Source:
  """Returns a log's pictures with their lens.

  Args:
    path: the file.
    start_ns: zero of the log's times.

  Raises:
    LensError: there is no lens, one of another kind, or pictures of another shape than the lens's.
  """
  info = next(_messages(path, CAMERA_INFO), None)
  if info is None:
    raise LensError(
      f"{path.name} has pictures but no lens on {CAMERA_INFO}: calibrate the camera and record it."
    )
  lens = _lens(path.name, info.message)
  reduction = 1
  while reduction < 8 and lens.width >= 2 * reduction * _WIDTH:
    reduction *= 2
  for reading in _messages(path, IMAGE):
    message = reading.message
    grey = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), _REDUCED[reduction])
    if grey is None:
      continue
    height, width = grey.shape
    if abs(width * lens.height / (height * lens.width) - 1) > _ASPECT:
      raise LensError(
        f"{path.name} has pictures of {width * reduction}x{height * reduction} pixels, its lens is "
        f"of {lens.width}x{lens.height}: record the lens of these pictures."
      )
    return Source(path, start_ns, lens.resized(width, height), reduction, message.header.frame_id)
  raise LensError(f"{path.name} has no readable picture on {IMAGE}, expected JPEG or PNG.")


def read(source: Source) -> Iterator[tuple[float, np.ndarray]]:
  """Yields stamps [s] and grey pictures uint8 [H, W]; repeated and damaged ones are left out."""
  last = b""
  shape = (source.lens.height, source.lens.width)
  for reading in _messages(source.path, IMAGE):
    data = bytes(reading.message.data)
    if data == last:  # a driver that was asked before the next picture came
      continue
    last = data
    grey = cv2.imdecode(np.frombuffer(data, np.uint8), _REDUCED[source.reduction])
    if grey is not None and grey.shape == shape:
      yield (reading.stamp_ns - source.start_ns) * NANO, grey


def _messages(path: pathlib.Path, topic: str) -> Iterator[Reading]:
  """Yields the messages of a topic, of a damaged file those that can be read."""
  return read_messages(path, topics=[topic], recover=True)


def _lens(name: str, info: Any) -> Camera:
  """Returns the lens of a CameraInfo."""
  distortion = [*info.d, 0.0, 0.0, 0.0, 0.0, 0.0]
  if info.distortion_model not in _MODELS or any(distortion[4:]):
    raise LensError(
      f"{name} has a lens with the distortion {info.distortion_model!r} {list(info.d)}, expected "
      "plumb_bob with k1, k2, p1, p2 and no more: calibrate with k3 fixed at 0."
    )
  fx, fy = float(info.k[0]), float(info.k[4])
  if not (fx > 0 and fy > 0):  # ROS: a camera that is not calibrated has zeros
    raise LensError(f"{name} has a lens that is not calibrated (focal length {fx}): calibrate it.")
  return Camera.from_opencv(info.width, info.height, info.k, distortion[:4])
