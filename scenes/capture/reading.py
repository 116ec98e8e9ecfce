"""Selects the sharpest keyframes of a video, of pictures or of a posed data set."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.picture_files import write_picture
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.capture import Capture, CaptureSettings, quality_warnings
from nerf2real.scenes.capture.kinds import holds_more, source_kind
from nerf2real.scenes.capture.media import stills
from nerf2real.scenes.capture.media.blur import blur_width
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.media.spacing import spread
from nerf2real.scenes.capture.media.stills import list_images, list_images_below
from nerf2real.scenes.capture.media.video import (
  Frame,
  inspect_video,
  limit_size,
  sharpest_frames,
  sharpness,
)
from nerf2real.scenes.capture.posed import agreement, depth_pictures
from nerf2real.scenes.capture.posed.colmap_model import read_colmap
from nerf2real.scenes.capture.posed.pictures import read_as_posed
from nerf2real.scenes.capture.posed.rgbd import read_rgbd
from nerf2real.scenes.capture.posed.transforms import read_transforms

# JPEG's rounding shows as faint features where a picture shows little: of a phone's film of a room
# whose parts hang together by blurred walls five of five attempts to map such keyframes were right,
# and none of four of JPEGs of quality 95 or 100.
_WITHOUT_LOSS = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # level 1: fast
_CANDIDATES = 3  # of a video, for each keyframe; chosen: what moves five times as fast is as dense
_BENT = 0.01  # of a picture's aspect; chosen: as of a known camera's
_KEYFRAME_RATE = 2.0  # of a long video [1/s]; chosen: about that of the shipped film, 150 in 70 s


def read_capture(
  source: Path,
  folder: Path,
  *,
  settings: CaptureSettings | None = None,
  progress: Progress = no_progress,
) -> Capture:
  """Reads a source and writes its keyframes.

  Args:
    source: A video, a folder of pictures, a folder with a COLMAP model, a transforms.json, or the
      folder of an RGB-D sequence in TUM's, 7-Scenes' or ScanNet's layout.
    folder: Where the keyframes are written; replaced as a whole and only when all went well.
    settings: What to keep and when to warn.
    progress: Called with the fraction done and a text.

  Raises:
    CaptureError: If the source cannot become a capture; the message is one line.
  """
  settings = settings or CaptureSettings()
  source, folder = Path(source), Path(folder)
  if settings.num_keyframes < settings.min_images:
    raise CaptureError(
      f"num_keyframes is {settings.num_keyframes}, expected at least {settings.min_images}."
    )
  kind = source_kind(source)
  with files.atomic_folder(folder) as partial:
    if kind == "video":
      capture = _read_video(source, partial, settings, progress)
    else:
      capture = _read_pictures(source, kind, partial, settings, progress)
  images = [folder / path.name for path in capture.images]
  return dataclasses.replace(capture, folder=folder, images=images)


def keyframe_count(settings: CaptureSettings, duration: float) -> int:
  """Returns how many keyframes a video of a length [s] gets."""
  return min(max(settings.num_keyframes, round(_KEYFRAME_RATE * duration)), settings.most)


def _read_video(
  source: Path, folder: Path, settings: CaptureSettings, progress: Progress
) -> Capture:
  info = inspect_video(source)
  if info.num_frames < settings.min_images:
    raise CaptureError(
      f"{source} has {info.num_frames} frames, expected a walk through the room "
      f"(at least {settings.min_images} frames, better a minute)."
    )
  warnings: list[str] = []
  if 0 < info.duration < settings.warn_duration:
    warnings.append(
      f"Too short: the video lasts {info.duration:.1f} s, expected {settings.warn_duration:.0f} s "
      "or more; walk slowly through the whole room."
    )
  count = keyframe_count(settings, info.duration)
  frames = sharpest_frames(
    source,
    _CANDIDATES * count,
    max_size=settings.max_size,
    info=info,
    warnings=warnings,
    progress=progress,
  )
  written = _spread(_write(frames, folder), count)
  return _gather("video", written, folder, settings, warnings)


def _read_pictures(
  source: Path, kind: str, folder: Path, settings: CaptureSettings, progress: Progress
) -> Capture:
  known = None
  readers = {"colmap": read_colmap, "transforms": read_transforms, "rgbd": read_rgbd}
  if kind in readers:
    known = readers[kind](source)
  files = list(known.files) if known else list_images(source) or list_images_below(source)
  if len(files) < settings.min_images:
    lost = f" ({' '.join(known.warnings)})" if known and known.warnings else ""
    more = None if known else holds_more(source, len(files))
    raise CaptureError(
      f"{source} holds {len(files)} pictures{lost}, expected at least {settings.min_images} that "
      f"overlap: {more or 'take more, from different places in the room'}."
    )
  if known is None:
    return _read_stills(source, files, folder, settings, progress)
  camera = known.camera

  def read(index: int) -> np.ndarray:
    image = read_as_posed(files[index], camera, least=settings.max_size)
    return limit_size(image, settings.max_size)

  warnings = list(known.warnings)
  measured = depth_pictures.Readable(known.depth_files)
  frames = _sharpest_pictures(
    files, read, settings.num_keyframes, warnings, progress, sound=measured.is_sound
  )
  written = _write(frames, folder)
  warnings.extend(measured.warnings())
  _check_count(source, len(written), settings, warnings)
  if kind != "rgbd":
    warnings.extend(_unused(len(written), len(files), settings.num_keyframes))
  capture = _gather(kind, written, folder, settings, warnings)
  known = known.selected(_numbers(capture), _written_camera(camera, capture))
  known, changed = agreement.settled(known, capture.images)
  capture.warnings.extend(changed)
  origins = [stills.printable(path) for path in known.files]
  return dataclasses.replace(capture, times=None, known=known.lifted(), origins=origins)


def _read_stills(
  source: Path, files: list[Path], folder: Path, settings: CaptureSettings, progress: Progress
) -> Capture:
  """Writes the keyframes of a folder of photographs."""
  found = stills.of_one_camera(files)
  _check_count(source, len(found.files), settings, found.warnings)
  size = found.size(settings.max_size)

  def read(index: int) -> np.ndarray:
    image = stills.read_still(found.files[index], least=max(size))
    if found.turned[index]:
      image = stills.quarter_turned(image)
    same = image.shape[1::-1] == size
    aspect = (image.shape[1] / image.shape[0]) / (size[0] / size[1])
    if abs(aspect - 1) > max(_BENT, 2 / min(size)):  # 2 pixels: small ones are rounded
      raise CaptureError(
        f"{found.files[index]} is {image.shape[1]}x{image.shape[0]}, expected the shape of "
        f"{size[0]}x{size[1]} that its header tells: copy it again."
      )
    return image if same else cv2.resize(image, size, interpolation=cv2.INTER_AREA)

  warnings = list(found.warnings)
  frames = _sharpest_pictures(found.files, read, settings.most, warnings, progress)
  written = _write(frames, folder)
  _check_count(source, len(written), settings, warnings)
  warnings.extend(_unused(len(written), len(found.files), settings.most))
  capture = _gather("images", written, folder, settings, warnings)
  numbers = _numbers(capture)
  turned = found.turned[numbers]
  return dataclasses.replace(
    capture,
    times=None,
    turned=turned if turned.any() else None,
    origins=[stills.printable(found.files[k]) for k in numbers],
  )


def _check_count(source: Path, count: int, settings: CaptureSettings, warnings: list[str]) -> None:
  """Raises CaptureError, with what was left out, where too few pictures remain."""
  if count < max(settings.min_images, 1):
    raise CaptureError(
      f"{source}: {' '.join(warnings)} At least {settings.min_images} different pictures of one "
      "camera are needed."
    )


def _unused(used: int, count: int, most: int) -> list[str]:
  """Says how many of `count` pictures are used where that are more than there may be."""
  if count <= most:
    return []
  return [
    f"{used} of {count} pictures are used, the sharpest of each few that follow each other: "
    f"--keyframes {count} uses all, and takes longer."
  ]


def _numbers(capture: Capture) -> list[int]:
  """Each keyframe's number in its source."""
  return [int(path.stem.split("_")[-1]) for path in capture.images]


def _written_camera(camera: Camera, capture: Capture) -> Camera:
  """Scales the source's camera to the keyframes as written, and checks that it is theirs."""
  ratio = (capture.width / camera.width) / (capture.height / camera.height)
  if abs(ratio - 1) > _BENT:
    raise CaptureError(
      f"The pictures are {capture.width}x{capture.height}, but the known camera is for "
      f"{camera.width}x{camera.height}: expected the same aspect."
    )
  return camera.resized(capture.width, capture.height)


def _sharpest_pictures(
  files: Sequence[Path],
  read: Callable[[int], np.ndarray],
  most: int,
  warnings: list[str],
  progress: Progress,
  *,
  sound: Callable[[int], bool] = lambda index: True,
) -> Iterator[Frame]:
  """Yields the sharpest of each of `most` equal parts of pictures.

  Args:
    files: The pictures.
    read: Reads one by its number.
    most: Parts, at most one per picture.
    warnings: Receives a line when some cannot be read.
    progress: Called with the fraction done and a text.
    sound: Tells by its number whether one may be taken, for another reason.
  """
  count, lost = len(files), []
  parts = min(most, count)
  edges = np.linspace(0, count, parts + 1).astype(int)
  for first, last in itertools.pairwise(edges):
    best: Frame | None = None
    for index in range(first, last):
      try:
        image = read(index)
      except CaptureError:
        lost.append(files[index])
        continue
      value = sharpness(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
      if (best is None or value > best.sharpness) and sound(index):
        best = Frame(index, 0.0, value, image)
    progress(last / count, f"picture {last} of {count}")
    if best is not None:
      yield best
  warnings.extend(stills.unreadable(lost, count))


@dataclasses.dataclass(frozen=True)
class _Written:
  """What is kept of a frame on disk."""

  path: Path
  index: int
  time: float
  travelled: float
  sharpness: float


def _write(frames: Iterator[Frame], folder: Path) -> list[_Written]:
  """Writes frames as they come."""
  written: list[_Written] = []
  size: tuple[int, int] | None = None
  for frame in frames:
    height, width = frame.image.shape[:2]
    size = size or (width, height)
    if size != (width, height):
      raise CaptureError(
        f"Picture {frame.index} is {width}x{height}, the ones before it {size[0]}x{size[1]}: "
        "expected one camera, one zoom and one orientation for the whole capture."
      )
    path = folder / f"frame_{frame.index:06d}.png"
    write_picture(path, frame.image, _WITHOUT_LOSS)
    written.append(_Written(path, frame.index, frame.time, frame.travelled, frame.sharpness))
  return written


def _spread(written: list[_Written], count: int) -> list[_Written]:
  """Keeps `count` of a film's frames, see `spacing.spread`, and removes the others."""
  rows = [[w.time, w.index, w.travelled, w.sharpness] for w in written]
  time, index, travelled, sharp = np.array(rows).T
  when = time if np.ptp(time) > 0 else index  # a bare stream has no times
  kept = spread(when, travelled, sharp, min(count, len(written)))
  for number in set(range(len(written))) - set(kept.tolist()):
    written[number].path.unlink()
  return [written[number] for number in kept]


def _gather(
  kind: str, written: list[_Written], folder: Path, settings: CaptureSettings, warnings: list[str]
) -> Capture:
  """Returns what is known of keyframes on disk, with the warnings about them."""
  brightness, blur = [], []
  for picture in written:
    image = stills.read_still(picture.path)
    brightness.append(float(image.mean()))
    blur.append(blur_width(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)))
  height, width = image.shape[:2]
  capture = Capture(
    kind=kind,
    folder=folder,
    images=[w.path for w in written],
    width=width,
    height=height,
    sharpness=np.array([w.sharpness for w in written]),
    brightness=np.array(brightness),
    times=np.array([w.time for w in written]),
    warnings=warnings,
    blur=np.array(blur),
  )
  warnings.extend(quality_warnings(capture, settings))
  return capture
