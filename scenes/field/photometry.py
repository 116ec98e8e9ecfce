"""Exposure and white balance of every picture, and the lens's falloff (vignetting).

A phone changes its exposure while it films, and its pictures darken towards their corners. The
colour of a scene point in picture k at radius r is modelled as gain_k * falloff(r) * colour, a
channel; all are fitted together to points that pictures share, robustly, in the logarithm.

Source of the model: Goldman 2010, "Vignette and exposure calibration and compensation", an even
polynomial of sixth degree; here it is the logarithm's, so that all is linear.
Shapes: N pictures, P points, M observations, H height, W width.
"""

from typing import NamedTuple

import cv2
import numpy as np
import scipy.sparse

from nerf2real.core.geometry.cameras import PIXEL_CENTRE, Camera
from nerf2real.scenes.poses.localisation import Localisation

_SMOOTHING = (
  2.0  # deviation of a colour's Gaussian [pixel]; chosen: hides a pixel's reprojection error
)
_DARKEST, _BRIGHTEST = 12.0, 243.0  # chosen: 5 % off the ends, where a value is noise or clipped
_ROUNDS = 12  # of reweighting; chosen: the gains move by less than 1e-3 after 8
_CORE = 0.03  # log residuals below this count quadratically; chosen: 7 levels of noise at 243
_PRIOR = (
  0.1  # a logarithm is pulled to 0 as by so many observations; chosen: matters without any only
)
_NOTICEABLE = 0.02  # log gains' spread, log light in a corner; chosen: less than can be seen
_CLIPPING = (235.0, 255.0)  # a value stays bright from here on; chosen: beyond the fit's range

_IN_RANGE = 98.0  # per cent of a picture's values, and of the pictures, that 255 holds when evened
_RANGE_STRIDE = 8  # pixels looked at for that


class Sightings(NamedTuple):
  """What pictures show of localised points."""

  pictures: np.ndarray  # [M] index of the picture
  points: np.ndarray  # [M] identity of the point
  colors: np.ndarray  # [M, 3] in [0, 255]
  radii: np.ndarray  # [M] from the principal point, see `radii`


class Exposure(NamedTuple):
  """How bright pictures show what they show."""

  gains: np.ndarray  # float64 [N, 3]
  falloff: np.ndarray  # float64 [3, 3]: of a channel's logarithm, by r^2, r^4, r^6

  def factors(self, index: int, camera: Camera) -> np.ndarray:
    """What a picture's colours are multiplied with, float32 [H, W, 3] for pictures of `camera`."""
    pixels = camera.pixel_centres()
    light = np.exp(_powers(radii(camera, pixels)) @ self.falloff.T)
    factors: np.ndarray = (light * self.gains[index]).astype(np.float32)
    return factors

  def select(self, indices: np.ndarray) -> "Exposure":
    """Returns that of the chosen pictures."""
    return self._replace(gains=self.gains[indices])

  @property
  def changes(self) -> bool:
    """Whether the pictures have more than one exposure."""
    return bool(np.any(self.gains != self.gains[:1]))

  @property
  def is_even(self) -> bool:
    """Whether all pictures have one exposure, and no falloff."""
    return not self.changes and not self.falloff.any()

  def for_range(self, images: np.ndarray, camera: Camera) -> "Exposure":
    """Raises all gains by one factor, so that evened pictures [N, H, W, 3] hardly exceed 255."""
    if self.is_even:
      return self
    step = slice(None, None, _RANGE_STRIDE)
    brightest = [
      np.percentile(image[step, step] / self.factors(index, camera)[step, step], _IN_RANGE)
      for index, image in enumerate(images)
    ]
    return self._replace(gains=self.gains * max(1.0, np.percentile(brightest, _IN_RANGE) / 255))

  @property
  def ratio(self) -> float:
    """How many times as bright as the darkest the brightest are: 95th to 5th percentile."""
    low, high = np.percentile(self.gains.mean(-1), [5, 95])
    return float(high / low)

  @property
  def corner(self) -> float:
    """Light in a picture's corner, as a share of its middle's."""
    return float(np.exp(self.falloff.sum(-1)).mean())


def radii(camera: Camera, pixels: np.ndarray) -> np.ndarray:
  """Distances [...] of pixels [..., 2] from the principal point, in halves of the diagonal."""
  away: np.ndarray = np.asarray(pixels, np.float64) - [camera.cx, camera.cy]
  return np.hypot(away[..., 0], away[..., 1]) / (0.5 * np.hypot(camera.width, camera.height))


def _powers(radius: np.ndarray) -> np.ndarray:
  """r^2, r^4, r^6 [..., 3]."""
  return np.square(radius)[..., None] ** np.arange(1, 4)


def sightings(found: Localisation, images: np.ndarray, camera: Camera) -> Sightings:
  """Looks the localised points up in the pictures that see them.

  Args:
    found: The localised pictures and points.
    images: uint8 [N, H, W, 3], of the localised size or smaller.
    camera: The pictures' camera.
  """
  view, point, pixel = found.tracks
  pixels = pixel * camera.size_ratio(found.camera)
  place = (pixels - PIXEL_CENTRE).astype(np.float32)
  colors = np.zeros((len(view), 3), np.float32)
  starts = np.searchsorted(view, np.arange(len(images) + 1))
  for k, image in enumerate(images):
    mine = slice(starts[k], starts[k + 1])
    if mine.start == mine.stop:
      continue
    looked = cv2.remap(
      cv2.GaussianBlur(image, (0, 0), _SMOOTHING).astype(np.float32),
      place[mine, :1],
      place[mine, 1:],
      cv2.INTER_LINEAR,
      borderMode=cv2.BORDER_REPLICATE,
    )
    colors[mine] = looked[:, 0]
  return Sightings(view, point, colors, radii(camera, pixels))


def fit_exposure(seen: Sightings, *, count: int) -> Exposure:
  """Fits a gain a picture and channel, and a falloff a channel.

  Args:
    seen: What the pictures show of the points.
    count: Number of pictures, N.

  Returns:
    The exposure; gains are exactly 1 where it was fixed, the falloff exactly 0 where there is none.
  """
  usable = (seen.colors.min(-1, initial=255.0) > _DARKEST) & (
    seen.colors.max(-1, initial=0.0) < _BRIGHTEST
  )
  even = Exposure(np.ones((count, 3)), np.zeros((3, 3)))
  if not usable.any():
    return even
  _, points = np.unique(seen.points[usable], return_inverse=True)
  rows = np.arange(len(points))
  pictures = scipy.sparse.csr_matrix(
    (np.ones(len(points)), (rows, seen.pictures[usable])), shape=(len(points), count)
  )
  design = scipy.sparse.hstack([pictures, _powers(seen.radii[usable])]).tocsr()
  values = np.log(seen.colors[usable].astype(np.float64))
  found = np.stack([_fit(design, points, values[:, channel]) for channel in range(3)])
  logs, falloff = found[:, :count].T, found[:, count:]
  logs = logs - logs.mean(0)
  return Exposure(
    gains=even.gains if logs.std(0).max() < _NOTICEABLE else np.exp(logs),
    falloff=even.falloff if np.abs(falloff.sum(-1)).max() < _NOTICEABLE else falloff,
  )


def _fit(design: scipy.sparse.csr_matrix, points: np.ndarray, values: np.ndarray) -> np.ndarray:
  """Solves values = design @ x + point's mean for x, the sum of absolute residuals least."""
  weights = np.ones(len(values))
  of_point = scipy.sparse.csr_matrix((np.ones(len(values)), (points, np.arange(len(values)))))
  for _ in range(_ROUNDS):
    weighted = scipy.sparse.diags(weights) @ design
    # The points' means are eliminated (Schur complement).
    total = of_point @ weights
    table = of_point @ weighted
    share = scipy.sparse.diags(1 / total) @ table
    matrix = (design.T @ weighted - table.T @ share).toarray() + _PRIOR * np.eye(design.shape[1])
    mean = of_point @ (weights * values)
    solution = np.linalg.solve(matrix, weighted.T @ values - share.T @ mean)
    means = (mean - table @ solution) / total
    residuals = values - design @ solution - means[points]
    weights = _CORE / np.maximum(np.abs(residuals), _CORE)
  return solution


def even_out(image: np.ndarray, factors: np.ndarray) -> np.ndarray:
  """Returns a picture uint8 [H, W, 3] as it would be with factors [H, W, 3] of 1.

  Clipped values stay bright.
  """
  values = image.astype(np.float32)
  low, high = _CLIPPING
  clipped = np.clip((values - low) / (high - low), 0, 1) * 255
  return np.clip(np.rint(np.maximum(values / factors, clipped)), 0, 255).astype(np.uint8)


def expose(image: np.ndarray, factors: np.ndarray) -> np.ndarray:
  """Returns an evened picture uint8 [H, W, 3] as a camera with factors [H, W, 3] shows it."""
  return np.clip(np.rint(image.astype(np.float32) * factors), 0, 255).astype(np.uint8)
