"""The newest picture of the robot's camera in the policy's size: its age, its loss, its record."""

import logging
from typing import Any

import numpy as np

from nerf2real.real.camera.source import CameraSource, check_shape, resize
from nerf2real.real.clock import Clock
from nerf2real.real.loop.timing import Timing

_SAME_PICTURE = 0.002  # s by which the age of one picture may be measured differently
_log = logging.getLogger(__name__)


class Pictures:
  """Reads the camera once a control step."""

  def __init__(
    self,
    camera: CameraSource,
    size: tuple[int, int],
    *,
    clock: Clock,
    timing: Timing,
    recorder: Any = None,
  ):
    """Takes the camera; `close` frees it.

    Args:
      camera: Source of pictures.
      size: (height, width) of the policy's picture.
      clock: The loop's.
      timing: Takes their ages.
      recorder: A `real.recorder.recorder.Recorder`, or None.
    """
    self.camera = camera
    self._size, self._clock, self._timing = size, clock, timing
    self._recorder = recorder
    self._recorded = float("-inf")  # s, when the picture recorded last was taken

  def read(self) -> tuple[np.ndarray, float | None]:
    """Returns the newest picture, uint8 [height, width, 3], and its age [s].

    A picture that cannot be read, or has another shape, is black and has no age (None).
    """
    age: float | None = None
    picture: np.ndarray = np.zeros((*self._size, 3), np.uint8)
    try:
      found, found_age = self.camera.read()
      check_shape(found, self._size)
      picture, age = found, found_age
    except Exception as error:  # whatever a driver raises, it is a lost picture
      _log.warning("no picture: %s: %s", type(error).__name__, error)
    now = self._clock.now()
    if age is not None:
      self._timing.add("camera age", age)
      self._record(picture, now - age)
    return resize(picture, self._size), age

  def _record(self, picture: np.ndarray, taken: float) -> None:
    if self._recorder is None or taken < self._recorded + _SAME_PICTURE:
      return
    self._recorded = taken
    self._recorder.image(self._clock.wall(taken), picture)

  def close(self) -> None:
    """Frees the camera."""
    self.camera.close()
