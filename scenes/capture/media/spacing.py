"""Where keyframes lie in a film: spread over its time, and over how far its picture moves.

A hand turns fast past plain walls and lingers before what is of interest. Keyframes at equal times
are then far apart where pictures share least, and two parts of a room hang together by little.
Shapes: C candidates, in the film's order.
"""

import itertools

import cv2
import numpy as np

_SHORT_SIDE = 160  # at which motion is measured [pixel]; chosen: a phone's blur is less than one
_CORNERS = 200  # that are followed from frame to frame, at most
_QUALITY = 0.01  # of the weakest corner, of the strongest's (OpenCV's tutorial has it so)
_APART = 8  # of two corners at least [pixel]


class ImageMotion:
  """How far a film's picture has moved: the median of followed corners, summed over frames.

  Source: Bouguet 2001, Pyramidal implementation of the Lucas Kanade feature tracker (OpenCV's).
  """

  def __init__(self):
    self.travelled = 0.0
    """Since the first frame [pixel at a short side of 160]."""
    self._before: np.ndarray | None = None
    self._last = 0.0

  def add(self, grey: np.ndarray) -> float:
    """Takes the next frame, grey uint8 [H, W], and returns `travelled`.

    A frame in which nothing can be followed has moved as far as the one before.
    """
    scale = _SHORT_SIDE / min(grey.shape)
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    now = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    if self._before is not None and self._before.shape == now.shape:
      self._last = self._moved(self._before, now)
      self.travelled += self._last
    self._before = now
    return self.travelled

  def _moved(self, before: np.ndarray, now: np.ndarray) -> float:
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _APART)
    if corners is None:
      return self._last
    start = np.zeros_like(corners)
    found, followed, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, start)
    steps = np.linalg.norm((found - corners)[followed == 1], axis=-1)
    return float(np.median(steps)) if len(steps) else self._last


def spread(
  time: np.ndarray, travelled: np.ndarray, sharpness: np.ndarray, count: int
) -> np.ndarray:
  """Chooses candidates: the sharpest of each of `count` parts that are as long.

  A part's length is half that of time and half that of motion, each as a share of the film's. So no
  part is longer than twice an even one in either. What does not grow has no share.

  Args:
    time: Of each candidate [s], or its frame's number where the film has no times [C].
    travelled: How far the picture had moved by then, see `ImageMotion` [C].
    sharpness: Of each [C].
    count: How many are chosen, at most C.

  Returns:
    Their rows, increasing [count].
  """
  grown = [np.maximum.accumulate(x - x[0]) for x in (time.astype(float), travelled)]
  length = sum(x / max(x[-1], 1e-12) for x in grown)
  length = length / max(length[-1], 1e-12)
  parts = np.arange(count + 1)
  edges = np.searchsorted(length, parts / count)
  edges[-1] = len(length)
  edges = np.maximum.accumulate(edges - parts) + parts  # at least one candidate in each part
  edges = np.minimum(edges, len(length) - count + parts)
  return np.array([a + int(np.argmax(sharpness[a:b])) for a, b in itertools.pairwise(edges)])
