"""How features move between pictures of a log: corners followed by pyramidal Lucas-Kanade.

Corners after J. Shi and C. Tomasi, Good features to track, CVPR 1994; tracking after J.-Y. Bouguet,
Pyramidal implementation of the Lucas Kanade feature tracker, Intel 2000, forwards and backwards:
who does not come back to where he started is dropped. All by OpenCV.

Shapes: P pairs of pictures, N tracks.
"""

import collections
import dataclasses

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import PIXEL_CENTRE
from nerf2real.sysid.sensors import pictures

Array = np.ndarray

APART = 0.1  # s between the two pictures; ours: three frames, in which a head turns by degrees
_APART_RANGE = (0.05, 0.2)  # s
_PAIRS = 300  # of a log
_CORNERS = 24  # in a picture
_QUALITY, _DISTANCE = 0.01, 12  # share of the best corner's strength; pixel between corners
_WINDOW, _LEVELS = (17, 17), 3  # pixel, halvings: follows up to about 60 pixels
_RETURNS = 0.3  # pixel from where a track started
_FEWEST = 6  # tracks of a pair that counts


@dataclasses.dataclass(frozen=True)
class Tracks:
  """Displacements in one log."""

  first: Array
  """[P] s, stamp of the earlier picture."""
  second: Array
  """[P] s, of the later one."""
  pair: Array
  """[N], to which pair a track belongs."""
  before: Array
  """[N, 2] pixel; the centre of the upper left pixel is (0.5, 0.5)."""
  after: Array
  """[N, 2]."""


def follow(source: pictures.Source, duration: float) -> Tracks:
  """Follows corners over `APART` seconds, all through a log that lasts `duration` [s]."""
  spacing = max(duration / _PAIRS, 0.02)
  kept: collections.deque[tuple[float, Array]] = collections.deque()
  first: list[float] = []
  second: list[float] = []
  index, before, after = [], [], []
  latest = -np.inf
  for stamp, grey in pictures.read(source):
    kept.append((stamp, grey))
    while kept[0][0] < stamp - _APART_RANGE[1]:
      kept.popleft()
    old, earlier = min(kept, key=lambda item: abs(stamp - item[0] - APART))
    if stamp - old < _APART_RANGE[0] or stamp - latest < spacing:
      continue
    latest = stamp
    start, end = _tracks(earlier, grey)
    if len(start) < _FEWEST:
      continue
    index.append(np.full(len(start), len(first)))
    first.append(old)
    second.append(stamp)
    before.append(start + PIXEL_CENTRE)
    after.append(end + PIXEL_CENTRE)
  points = np.zeros((0, 2))
  return Tracks(
    np.array(first),
    np.array(second),
    np.concatenate([np.zeros(0, int), *index]),
    np.concatenate([points, *before]),
    np.concatenate([points, *after]),
  )


def _tracks(earlier: Array, later: Array) -> tuple[Array, Array]:
  """Returns where corners are in two pictures [n, 2], [n, 2]."""
  nothing = np.zeros((0, 2))
  corners = cv2.goodFeaturesToTrack(earlier, _CORNERS, _QUALITY, _DISTANCE)
  if corners is None:
    return nothing, nothing
  settings = {"winSize": _WINDOW, "maxLevel": _LEVELS}
  moved, found, _ = cv2.calcOpticalFlowPyrLK(earlier, later, corners, None, **settings)  # type: ignore[call-overload]
  back, returned, _ = cv2.calcOpticalFlowPyrLK(later, earlier, moved, None, **settings)  # type: ignore[call-overload]
  start, end, home = (np.asarray(p, np.float64).reshape(-1, 2) for p in (corners, moved, back))
  size = np.array(later.shape[::-1])
  good = (found.ravel() == 1) & (returned.ravel() == 1)
  good &= np.linalg.norm(home - start, axis=1) < _RETURNS
  good &= np.all((end > 0) & (end < size - 1), axis=1)
  return start[good], end[good]
