"""Reads a video in one streaming pass and keeps the sharpest frame of each part.

Memory holds one candidate picture, never the film: a video of any length streams through.
"""

import collections
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import av
import av.error
import cv2
import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.media import colors
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.media.spacing import ImageMotion

STANDARD_SIZE = 480  # short side at which sharpness is measured [pixel]; chosen: less than any
# phone's video, so that resolutions are comparable; pictures are never enlarged
DAMAGED_FRACTION = 0.02  # of frames lost before a video counts as damaged


@dataclasses.dataclass(frozen=True)
class Frame:
  """A picture chosen from a video."""

  index: int
  """Number of the frame in the video."""
  time: float
  """Presentation time [s]."""
  sharpness: float
  """Variance of the Laplacian at the standard size [grey level^2]."""
  image: np.ndarray
  """Upright BGR picture uint8 [H, W, 3]."""
  travelled: float = 0.0
  """How far the video's picture had moved by then, see `spacing.ImageMotion`."""


@dataclasses.dataclass(frozen=True)
class VideoInfo:
  """Facts of a video's header and packets, without decoding."""

  num_frames: int
  """Packets of the video stream that are shown: those that an edit list cuts off are not."""
  expected_frames: int
  """Those, or what the header promises where the packets end early."""
  frames_per_second: float
  """Mean rate [1/s]; 0 where unknown."""

  @property
  def duration(self) -> float:
    """Length of the film [s]; 0 where the rate is unknown."""
    return self.num_frames / self.frames_per_second if self.frames_per_second > 0 else 0.0


def _standard_size(width: int, height: int) -> tuple[int, int]:
  """Width and height of a picture at the standard size; its own where it is not larger."""
  factor = min(STANDARD_SIZE / min(width, height), 1.0)
  return max(1, round(width * factor)), max(1, round(height * factor))


def at_standard_size(grey: np.ndarray) -> np.ndarray:
  """A grey picture [H, W], reduced to the standard size where it is larger."""
  size = _standard_size(grey.shape[1], grey.shape[0])
  same = size == grey.shape[1::-1]
  return grey if same else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _grey(frame: av.VideoFrame) -> np.ndarray:
  """The grey picture of a frame at the standard size, reduced while it is converted: a frame of
  3840x2160 in 10 bits takes 12 ms so, and 53 ms where it is converted first."""
  width, height = _standard_size(frame.width, frame.height)
  return frame.reformat(width, height, format="gray", interpolation="AREA").to_ndarray()


def sharpness(grey: np.ndarray) -> float:
  """Variance of the Laplacian of a grey picture [H, W] at the standard size.

  Source: Pech-Pacheco et al. 2000, Diatom autofocusing in brightfield microscopy, LAP_VAR.
  """
  return float(cv2.Laplacian(at_standard_size(grey), cv2.CV_32F).var())


def inspect_video(path: Path) -> VideoInfo:
  """Counts a video's frames from its packets, without decoding.

  Raises:
    CaptureError: If the file is no video, has no video stream or no frame.
  """
  try:
    with av.open(str(path)) as container:
      if not container.streams.video:
        raise CaptureError(f"{path} has no video stream (sound only?); give the video itself.")
      stream = container.streams.video[0]
      count, end, broken = 0, 0, False
      try:
        for packet in container.demux(stream):
          if packet.size and not packet.is_discard:
            count += 1
            shown = packet.dts if packet.pts is None else packet.pts
            end = max(end, (shown or 0) + (packet.duration or 0))
      except av.error.FFmpegError:
        count, broken = max(count, 1), True  # decoding shows where it breaks
      rate = float(stream.average_rate or stream.guessed_rate or 0)
      early = broken or _ends_early(stream, end, rate)
      return VideoInfo(
        num_frames=count,
        expected_frames=max(count, stream.frames) if early else count,
        frames_per_second=rate,
      )
  except av.error.FFmpegError as error:
    size = path.stat().st_size
    what = "is empty (0 bytes)" if size == 0 else f"cannot be read as a video ({error.strerror})"
    raise CaptureError(
      f"{path} {what}: copy it from the phone again, or give a folder of images."
    ) from error


def _ends_early(stream: av.VideoStream, end: int, rate: float) -> bool:
  """Whether packets end [the stream's unit] before its header says, or it says nothing."""
  if stream.duration is None or stream.time_base is None:
    return True
  missing = float((stream.duration + (stream.start_time or 0) - end) * stream.time_base)
  length = float(stream.duration * stream.time_base)
  return missing > max(1 / rate if rate > 0 else 0.0, DAMAGED_FRACTION * length)


def _decode(path: Path, counts: collections.Counter) -> Iterator[av.VideoFrame]:
  """Yields decoded frames; a broken packet is counted and skipped, a broken container ends."""
  with av.open(str(path)) as container:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    packets = container.demux(stream)
    while True:
      try:
        packet = next(packets)
      except StopIteration:
        return
      except av.error.FFmpegError:
        counts["broken"] += 1
        return
      try:
        for frame in packet.decode():
          counts["decoded"] += 1
          counts["broken"] += bool(frame.is_corrupt)
          yield frame
      except av.error.FFmpegError:
        counts["broken"] += 1


def _upright(frame: av.VideoFrame, max_size: int) -> np.ndarray:
  """Converts to BGR, honours rotation and colours' metadata, limits the long side to max_size."""
  to_standard = colors.standard(frame)
  stored = frame.to_ndarray(format="bgr24" if to_standard is None else "bgr48le")
  # frame.rotation is counter-clockwise in degrees: what has to be done to see it upright.
  turns = round(frame.rotation / 90) % 4
  picture = limit_size(np.ascontiguousarray(np.rot90(stored, turns)), max_size)
  return picture if to_standard is None else to_standard(picture)


def limit_size(image: np.ndarray, max_size: int) -> np.ndarray:
  """Reduces a picture so that its long side is at most max_size [pixel]."""
  height, width = image.shape[:2]
  factor = max_size / max(height, width)
  if factor >= 1:
    return image
  size = (round(width * factor), round(height * factor))
  return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def sharpest_frames(
  path: Path,
  num_parts: int,
  *,
  max_size: int,
  info: VideoInfo,
  warnings: list[str],
  progress: Progress = no_progress,
) -> Iterator[Frame]:
  """Cuts a video into equal parts and yields the sharpest frame of each.

  Args:
    path: The video.
    num_parts: Number of parts, at most one per frame.
    max_size: Longer pictures are reduced to this long side [pixel].
    info: From `inspect_video`.
    warnings: Receives a line when a little of the video was damaged.
    progress: Called with the fraction done and a text.

  Raises:
    CaptureError: If more than DAMAGED_FRACTION of the video cannot be decoded.
  """
  parts = min(num_parts, info.num_frames)
  edges = np.linspace(0, info.num_frames, parts + 1).astype(int)
  counts: collections.Counter = collections.Counter()
  best: tuple[float, int, av.VideoFrame, float] | None = None
  motion = ImageMotion()
  part, last_time, hdr = 0, 0.0, None
  for index, frame in enumerate(_decode(path, counts)):
    last_time, hdr = float(frame.time or 0.0), colors.hdr_name(frame)
    while part + 1 < parts and index >= edges[part + 1]:
      if best is not None:
        yield _chosen(best, max_size)
      best, part = None, part + 1
    grey = _grey(frame)
    value, travelled = sharpness(grey), motion.add(grey)
    if best is None or value > best[0]:
      best = (value, index, frame, travelled)
    if index % 10 == 0:
      progress(min(1.0, index / info.num_frames), f"frame {index} of {info.num_frames}")
  expected = info.expected_frames
  lost = max(expected - counts["decoded"], 0) + counts["broken"]
  if counts["decoded"] == 0 or lost > max(1, DAMAGED_FRACTION * expected):
    raise CaptureError(
      f"{path} is damaged: {counts['decoded']} of {expected} frames decoded, until "
      f"{last_time:.1f} s, {counts['broken']} of them broken; copy it again, or cut the good part: "
      f"ffmpeg -i {path.name} -t {max(last_time - 1, 1):.0f} good.mp4"
    )
  if lost:
    warnings.append(f"{lost} of {expected} frames of the video are damaged and may show blocks.")
  if hdr is not None:
    warnings.append(
      f"The video is HDR ({hdr}): its colours were brought to the standard range, and what is "
      "brighter than white is white; better switch HDR video off in the settings of the camera."
    )
  if best is not None:
    yield _chosen(best, max_size)


def _chosen(best: tuple[float, int, av.VideoFrame, float], max_size: int) -> Frame:
  value, index, frame, travelled = best
  return Frame(index, float(frame.time or 0.0), value, _upright(frame, max_size), travelled)
