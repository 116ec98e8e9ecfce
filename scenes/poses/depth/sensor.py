"""Finds where a depth sensor sits beside the pictures' camera, and aligns its depth with them.

A Kinect measures depth with a second camera, of another focal length, a few centimetres beside the
first; a recording may hold it as measured (7-Scenes), and lifted by the pictures' camera it is off
by 10 % of a view's width at its border. Localised points tell: seen by the sensor, each has the
depth that the sensor measured there. Shapes: N pictures, O observations, H height, W width.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from scipy import optimize

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.poses.localisation import Localisation, sure_tracks

_FEWEST = 500  # observations for each half: fewer decide nothing
_OUTLIER = 0.05  # relative error of the depth from which it counts no more
_CLEARLY = 0.8  # of the error of depth that is taken as aligned; less, and a sensor of its own is
_STEPS = (0.1, 0.03, 0.03, 0.03, 0.03)  # of the search: log of the focal length, rays' tangents, m
_SEARCHES = 3


@dataclasses.dataclass(frozen=True)
class Sensor:
  """A depth sensor beside the pictures' camera, that looks as it does."""

  camera: Camera
  """Of the depth pictures; without distortion."""
  right: float
  """Of the pictures' camera's centre [m]."""
  below: float
  """The pictures' camera's centre [m]."""

  @property
  def _centre(self) -> np.ndarray:
    return np.array([self.right, self.below, 0.0])

  def aligned(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth as the pictures' camera would have measured it.

    Args:
      depth: z-depth [H, W] [m], 0 where nothing was measured.
      camera: Of the pictures, with a picture of the depth's size.

    Returns:
      z-depth float32 [H, W] [m], the nearest where several meet; 0 where nothing was measured.
    """
    beside = np.eye(4)
    beside[:3, 3] = self._centre
    return depth_pictures.seen_from(depth, self.camera.rays(), beside, camera)


class _Sighted(NamedTuple):
  """Observations of localised points and the depth pictures that go with them."""

  picture: np.ndarray  # [O]
  pixel: np.ndarray  # [O, 2] where the picture shows it, at the depth pictures' size
  point: np.ndarray  # [O, 3] in the pictures' camera's frame [m]
  depth: np.ndarray  # [N, H, W] z-depth in a unit, 0 where nothing was measured
  unit: float  # [m]

  def chosen(self, rows: np.ndarray) -> "_Sighted":
    return self._replace(picture=self.picture[rows], pixel=self.pixel[rows], point=self.point[rows])

  def error(self, pixel: np.ndarray, expected: np.ndarray) -> float:
    """Mean relative error of the depth measured at pixels [O, 2], outliers cut."""
    _, height, width = self.depth.shape
    column, row = np.floor(pixel).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = self.unit * self.depth[self.picture[inside], row[inside], column[inside]]
    off = np.abs(measured / expected[inside] - 1)[measured > 0]
    return float(np.minimum(off, _OUTLIER).mean()) if len(off) >= _FEWEST else _OUTLIER

  def error_of(self, sensor: Sensor) -> float:
    """The same for a sensor of its own."""
    beside = self.point - sensor._centre
    return self.error(sensor.camera.project(beside), beside[:, 2])


def _sighted(found: Localisation, depth: np.ndarray, unit: float) -> _Sighted:
  seen = sure_tracks(found)
  poses = found.world_from_camera[seen.view]
  local = np.einsum("oji,oj->oi", poses[:, :3, :3], found.points[seen.point] - poses[:, :3, 3])
  size = np.array([depth.shape[2], depth.shape[1]]) / [found.camera.width, found.camera.height]
  ahead = local[:, 2] > 0
  return _Sighted(
    seen.view[ahead],
    (seen.pixel * size)[ahead],
    local[ahead] / found.unit_from_source.scale,
    depth,
    unit,
  )


def at_their_time(
  found: Localisation,
  depth: np.ndarray,
  picture_from_depth: np.ndarray,
  *,
  unit: float,
  progress: Progress = no_progress,
) -> np.ndarray | None:
  """Depth as it would have been measured when the pictures were taken.

  A sensor with a clock of its own measures up to half a period before or after, and what a hand
  turned meanwhile puts edges pixels beside those of the picture. Whether stamps tell the truth is
  asked of the localised points.

  Args:
    found: The localised pictures, with metric poses in the source's frame.
    depth: Their depth pictures, z-depth [N, H, W] in a unit, 0 where nothing was measured.
    picture_from_depth: The camera's pose [N, 4, 4] when the depth was measured, in its frame when
      the picture was taken [m].
    unit: That unit [m].
    progress: Called with the fraction done and a text.

  Returns:
    The moved depth, of the same shape and unit; None where localised points agree with it no better
    than with the depth as it is.
  """
  camera = found.camera.resized(depth.shape[2], depth.shape[1])
  rays, moved = camera.rays(), np.zeros_like(depth)
  for number, motion in enumerate(picture_from_depth):
    seen = depth_pictures.seen_from(depth[number] * unit, rays, motion, camera)
    moved[number] = np.rint(seen / unit)
    progress((number + 1) / len(depth), f"depth of picture {number + 1} of {len(depth)}")
  before, after = (_sighted(found, pictures, unit) for pictures in (depth, moved))
  if len(before.picture) < _FEWEST:
    return None
  errors = [sighted.error(sighted.pixel, sighted.point[:, 2]) for sighted in (before, after)]
  return moved if errors[1] < errors[0] else None


def find_sensor(found: Localisation, depth: np.ndarray, *, unit: float) -> Sensor | None:
  """Finds a sensor that explains measured depth clearly better than the pictures' own camera.

  Focal length, principal point and place are searched on every second picture; the others judge.

  Args:
    found: The localised pictures, with metric poses in the source's frame.
    depth: Their depth pictures, z-depth [N, H, W] in a unit, 0 where nothing was measured.
    unit: That unit [m].

  Returns:
    The sensor; None where the depth is aligned with the pictures, or nothing can be said.
  """
  sighted = _sighted(found, depth, unit)
  halves = [sighted.chosen(np.flatnonzero(sighted.picture % 2 == k)) for k in (0, 1)]
  if min(len(half.picture) for half in halves) < _FEWEST:
    return None
  _, height, width = depth.shape
  start = found.camera.resized(width, height)
  focal = float(0.5 * (start.fx + start.fy))

  def sensor(numbers: np.ndarray) -> Sensor:
    zoom, across, down, right, below = (float(number) for number in numbers)
    own = focal * math.exp(zoom)
    camera = Camera(
      width=width,
      height=height,
      fx=own,
      fy=own,
      cx=start.cx + focal * across,
      cy=start.cy + focal * down,
    )
    return Sensor(camera, right, below)

  first, other = halves
  best = np.zeros(len(_STEPS))
  for _ in range(_SEARCHES):  # a simplex that has collapsed begins anew where it is
    simplex = best + np.vstack([np.zeros(len(_STEPS)), np.diag(_STEPS)])
    best = optimize.minimize(
      lambda numbers: first.error_of(sensor(numbers)),
      best,
      method="Nelder-Mead",
      options={"initial_simplex": simplex, "maxfev": 400},
    ).x
  chosen = sensor(best)
  aligned = other.error(other.pixel, other.point[:, 2])
  return chosen if other.error_of(chosen) < _CLEARLY * aligned else None
