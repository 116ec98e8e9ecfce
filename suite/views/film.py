"""Films of a task: third person, the robot's view and the map, as a video or an animation."""

import contextlib
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import av
import cv2
import numpy as np
from PIL import Image

from nerf2real.core import files
from nerf2real.suite.op3 import constants
from nerf2real.suite.views.overview import TopDown
from nerf2real.suite.views.third_person import ThirdPerson

FRAME_STEPS = 2  # control steps between frames: 20 frames/s
HEIGHT, WIDTH = 360, 480  # pixels of the third person's picture and of the enlarged robot's view
_INK, _PAPER = (29, 35, 48), (255, 255, 255)
_STRIP = 44  # pixels of text under the pictures
_ANIMATED: dict[str, dict[str, Any]] = {
  ".webp": {"quality": 60, "method": 4},
  ".gif": {},
}  # Pillow's options
_SHARE = 2  # of an animation's pictures every so many-th is kept, and reduced by it


class Sink(Protocol):
  """A file that grows frame by frame."""

  def add(self, frame: np.ndarray) -> None:
    """Adds a frame, RGB uint8 [H, W, 3]."""

  def close(self) -> None:
    """Writes what is left."""


class Video:
  """An H.264 file."""

  def __init__(self, path: Path):
    rate = Fraction(1 / (constants.CONTROL_TIMESTEP * FRAME_STEPS)).limit_denominator(1000)
    self._container = av.open(str(path), "w")
    self._stream = self._container.add_stream("libx264", rate=rate, options={"crf": "23"})
    self._stream.pix_fmt = "yuv420p"

  def add(self, frame: np.ndarray) -> None:
    """Adds a frame, RGB uint8 [H, W, 3]."""
    if not self._stream.codec_context.is_open:
      self._stream.height, self._stream.width = frame.shape[:2]
    for packet in self._stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")):
      self._container.mux(packet)

  def close(self) -> None:
    """Writes what is left."""
    for packet in self._stream.encode():
      self._container.mux(packet)
    self._container.close()


class Animation:
  """An animated WebP or GIF of half the size and half the frames, for a page."""

  def __init__(self, path: Path):
    self._path = path
    self._frames: list[Image.Image] = []
    self._given = 0

  def add(self, frame: np.ndarray) -> None:
    """Adds a frame, RGB uint8 [H, W, 3]."""
    if self._given % _SHARE == 0:
      size = (frame.shape[1] // _SHARE, frame.shape[0] // _SHARE)
      self._frames.append(Image.fromarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA)))
    self._given += 1

  def close(self) -> None:
    """Writes the file; none without a frame."""
    if self._frames:
      period = round(1000 * constants.CONTROL_TIMESTEP * FRAME_STEPS * _SHARE)  # ms
      first, *others = self._frames
      options = _ANIMATED[self._path.suffix]
      first.save(
        self._path, save_all=True, append_images=others, duration=period, loop=0, **options
      )


@contextlib.contextmanager
def open_film(path: Path) -> Iterator[Sink]:
  """Opens a film for writing, its folder is made; the file appears, whole, at the context's end.

  What was filmed until Ctrl-C is kept, too: a film that plays.

  Args:
    path: An .mp4, .webp or .gif file.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
    OSError: The file cannot be written.
    ValueError: Another suffix.
  """
  check_film(path)
  path.parent.mkdir(parents=True, exist_ok=True)
  files.check_writable(path)  # the libraries open it late, when all has been rendered
  interrupt: KeyboardInterrupt | None = None
  with files.atomic_path(path) as partial:
    sink: Sink = Video(partial) if path.suffix == ".mp4" else Animation(partial)
    try:
      yield sink
    except KeyboardInterrupt as error:
      interrupt = error
    sink.close()
  if interrupt is not None:
    raise interrupt


def check_film(path: Path) -> None:
  """Raises ValueError for a file whose suffix is none of a film's."""
  known = (".mp4", *_ANIMATED)
  if path.suffix not in known:
    raise ValueError(f"{path} is no name of a film: expected one that ends in {', '.join(known)}.")


def compose(pictures: list[np.ndarray], text: str) -> np.ndarray:
  """Returns the pictures side by side above a line of text; width and height are even."""
  row = np.hstack(pictures)
  strip = np.full((_STRIP, row.shape[1], 3), _PAPER, np.uint8)
  cv2.putText(strip, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.52, _INK, 1, cv2.LINE_AA)
  frame = np.vstack([row, strip])
  return np.ascontiguousarray(frame[:, : frame.shape[1] // 2 * 2])


class Film:
  """Draws an environment's frames into a film."""

  def __init__(self, environment: Any, sink: Sink):
    """Prepares the views.

    Args:
      environment: From `suite.load`, with pictures.
      sink: Takes the frames.
    """
    self._environment, self._task, self._sink = environment, environment.task, sink
    self._third: ThirdPerson | None = None  # made with the first episode, where the robot is
    self._map = TopDown(self._task, HEIGHT)
    self._step = 0

  @property
  def map_extent(self) -> Any:
    """What the map shows, for densities that are drawn on it."""
    return self._map.extent

  def restart(self) -> None:
    """Begins an episode; to be called before the first frame."""
    if self._third is None:
      physics = self._environment.physics
      self._third = ThirdPerson(self._task, physics, height=HEIGHT, width=WIDTH)
    self._third.restart()
    self._map.restart()

  def add(
    self,
    observation: Mapping[str, np.ndarray],
    text: str,
    *,
    density: np.ndarray | None = None,
  ) -> None:
    """Takes one control step; every second one is a frame.

    Args:
      observation: With the robot's picture.
      text: Under the pictures.
      density: Where a policy expects to be on the map, `Driver.density`.
    """
    self._step += 1
    if self._step % FRAME_STEPS or self._third is None:
      return
    own = cv2.resize(observation["camera"], (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    self._sink.add(compose([self._third.draw(), own, self._map.draw(density)], text))


def describe(name: str, task: Any) -> str:
  """Returns the line of text under a frame."""
  terms = "  ".join(f"{term} {value:+.2f}" for term, value in task.reward_terms.items())
  return f"{name}  {task.outcome.duration:5.2f} s   {terms}"
