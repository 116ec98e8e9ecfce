"""Estimates a rolling shutter's readout time and takes it out of observations and pictures.

A phone reads its sensor line by line, along the picture's shorter side, so that a line's pose is
that of its own instant. With the motion between neighbouring keyframes known, an observation moves
to where a shutter that reads all lines at once, in the middle of the readout, would have seen it;
the readout time is the one whose observations an adjustment of poses, points and lens fits best.
Source of the model: Hedborg et al. 2012, Rolling shutter bundle adjustment, with the motion of
neighbouring keyframes in place of a pose a frame. Shapes: N pictures, H height, W width.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from nerf2real.core.cameras import PIXEL_CENTRE, Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.capture.posed.colmap_model import to_opencv
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.mapping import registered

_LONGEST = 0.034  # s: a frame at 30 Hz; no video reads a frame for longer than it lasts
_PRECISION = 0.002  # s of the readout: a fifth of a pixel in a fast pan
_SEARCHED = 300  # keyframes in the search's adjustments at most, chosen: as many as a film has
_TRIALS = 9  # adjustments that a search to that precision takes, for its progress
_ROUNDS = 3  # final adjustments, each with the motion of the poses before
_FARTHEST_NEIGHBOURS = 2.0  # s between two keyframes that say how the one between them moved
_SETTLE = 3  # fixed-point steps of a pixel's instant; a line moves by a few pixels
_GRID = 8  # pixels between those whose shift is computed; it is smooth

Adjust = Callable[[pycolmap.Reconstruction], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shutter:
  """Motion of the cameras while a picture is read, from its first line to its last."""

  readout: float
  """From the first line to the last [s]; negative where the last is read first."""
  rotations: np.ndarray
  """Rotation vectors in the camera's frame [N, 3] [rad]."""
  translations: np.ndarray
  """In the camera's frame [N, 3], in the model's unit of length."""
  depths: np.ndarray
  """Median depth of the points that a picture sees [N]."""

  def scaled(self, scale: float) -> "Shutter":
    """Returns the same motion in another unit of length."""
    return dataclasses.replace(
      self, translations=scale * self.translations, depths=scale * self.depths
    )

  def of(self, pictures: slice | np.ndarray) -> "Shutter":
    """Returns the motion of some of the pictures, by a slice or by bool [N]."""
    return dataclasses.replace(
      self,
      rotations=self.rotations[pictures],
      translations=self.translations[pictures],
      depths=self.depths[pictures],
    )

  def project(
    self, points: np.ndarray, instants: np.ndarray, index: int, camera: Camera
  ) -> np.ndarray:
    """Projects points [..., 3] of a picture's middle pose at instants [...] to pixels [..., 2].

    First order in the rotation: at 1 degree a readout the error is 0.03 pixel.
    """
    speed = np.cross(self.rotations[index], points) + self.translations[index]
    return camera.project(points - instants[..., None] * speed)

  def rectify(self, image: np.ndarray, camera: Camera, index: int) -> np.ndarray:
    """Resamples a picture [H, W, 3] as if all lines were read in the middle of the readout.

    The share of the motion that depends on depth is that of the picture's median depth.
    """
    size = (camera.width, camera.height)
    coarse = [-(-length // _GRID) for length in size]
    target = camera.resized(*coarse).pixel_centres() * np.divide(size, coarse)
    points = camera.rays(target) * self.depths[index]
    source = target
    for _ in range(_SETTLE):
      source = self.project(points, instants(source, camera), index, camera)
    shift = cv2.resize(source - target, size, interpolation=cv2.INTER_LINEAR)
    maps = (camera.pixel_centres() + shift - PIXEL_CENTRE).astype(np.float32)
    found: np.ndarray = cv2.remap(
      image, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return found

  def straightened(self, pixels: np.ndarray, camera: Camera, index: int) -> np.ndarray:
    """Moves pixels [..., 2] of a picture as read to where `rectify` puts what they show."""
    points = camera.rays(pixels) * self.depths[index]
    shift = self.project(points, instants(pixels, camera), index, camera) - pixels
    moved: np.ndarray = pixels - shift
    return moved


def instants(pixels: np.ndarray, camera: Camera) -> np.ndarray:
  """Instant [...] at which pixels [..., 2] are read: -0.5 the first line's, 0.5 the last's."""
  axis = 1 if camera.height <= camera.width else 0
  length = min(camera.height, camera.width)
  return np.clip(pixels[..., axis] / length - 0.5, -0.5, 0.5)


class _Sight(NamedTuple):
  """What a picture saw, as measured."""

  rows: np.ndarray  # indices into its points2D [O]
  pixels: np.ndarray  # [O, 2]


def _measured(model: pycolmap.Reconstruction) -> list[_Sight]:
  sights = []
  for image in registered(model):
    places = image.points2D
    rows = np.array([k for k, place in enumerate(places) if place.has_point3D()], np.int64)
    sights.append(_Sight(rows, np.array([places[int(k)].xy for k in rows]).reshape(-1, 2)))
  return sights


def _local_points(
  model: pycolmap.Reconstruction, image: pycolmap.Image, rows: np.ndarray
) -> np.ndarray:
  """Points [O, 3] that a picture's observations show, in its camera's frame."""
  places, pose = image.points2D, image.cam_from_world()
  world = np.array([model.points3D[places[int(k)].point3D_id].xyz for k in rows]).reshape(-1, 3)
  local: np.ndarray = world @ pose.rotation.matrix().T + pose.translation
  return local


def motion(model: pycolmap.Reconstruction, times: Mapping[str, float], readout: float) -> Shutter:
  """Derives the motion during the readout from the poses of neighbouring keyframes.

  Args:
    model: Localised pictures.
    times: When each was taken [s].
    readout: From the first line to the last [s].
  """
  images = registered(model)
  when = np.array([times[image.name] for image in images])
  poses = [image.cam_from_world().inverse() for image in images]
  rotations = Rotation.from_matrix([pose.rotation.matrix() for pose in poses])
  centres = np.array([pose.translation for pose in poses])
  before = np.maximum(np.arange(len(images)) - 1, 0)
  after = np.minimum(np.arange(len(images)) + 1, len(images) - 1)
  lasted = when[after] - when[before]
  share = np.where(lasted < _FARTHEST_NEIGHBOURS, readout / lasted, 0.0)[:, None]
  depths = [
    np.median(_local_points(model, image, sight.rows)[:, 2])
    for image, sight in zip(images, _measured(model), strict=True)
  ]
  return Shutter(
    readout=readout,
    rotations=share * (rotations[before].inv() * rotations[after]).as_rotvec(),
    translations=share * rotations.inv().apply(centres[after] - centres[before]),
    depths=np.array(depths),
  )


def _move_observations(
  model: pycolmap.Reconstruction, measured: list[_Sight], shutter: Shutter
) -> None:
  """Moves the observations of a model, in place, to the middle of the readout."""
  camera = to_opencv(next(iter(model.cameras.values())))
  for index, (image, sight) in enumerate(zip(registered(model), measured, strict=True)):
    points = _local_points(model, image, sight.rows)
    shift = shutter.project(points, instants(sight.pixels, camera), index, camera)
    shift -= camera.project(points)
    for k, pixel in zip(sight.rows, sight.pixels - shift, strict=True):
      image.points2D[int(k)].xy = pixel


def _cost(model: pycolmap.Reconstruction, measured: list[_Sight]) -> float:
  """Sum of the Cauchy losses of all reprojection errors [pixel]."""
  camera = to_opencv(next(iter(model.cameras.values())))
  total = 0.0
  for image, sight in zip(registered(model), measured, strict=True):
    found = camera.project(_local_points(model, image, sight.rows))
    seen = np.array([image.points2D[int(k)].xy for k in sight.rows])
    total += float(np.log1p(np.square(found - seen).sum(-1)).sum())
  return total


def correct(
  model: pycolmap.Reconstruction,
  times: Mapping[str, float],
  adjust: Adjust,
  *,
  report: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, Shutter]:
  """Estimates the readout time and returns the model without its effect, and the motion.

  Of many keyframes the search adjusts every so many, with the motion between all; the model
  returned has all of them.

  Args:
    model: Adjusted as if all lines were read at once.
    times: When each picture was taken [s].
    adjust: Adjusts poses, points and lens of a model in place; keeps all observations of the
      pictures that have a pose.
    report: Called with the fraction done and a text.
  """
  every = -(-len(registered(model)) // _SEARCHED)
  few, done = _thinned(model, every), 0
  seen = _measured(few)

  def said(readout: float) -> None:
    nonlocal done
    done += 1
    report(min(1.0, done / (_TRIALS + _ROUNDS)), f"rolling shutter of {1e3 * readout:.0f} ms")

  def cost(readout: float) -> float:
    tried = pycolmap.Reconstruction(few)
    _move_observations(tried, seen, motion(model, times, readout).of(slice(None, None, every)))
    adjust(tried)
    said(readout)
    return _cost(tried, seen)

  bounds, precision = (-_LONGEST, _LONGEST), {"xatol": _PRECISION}
  best = float(optimize.minimize_scalar(cost, bounds=bounds, options=precision).x)
  result, measured = pycolmap.Reconstruction(model), _measured(model)
  for _ in range(_ROUNDS):
    _move_observations(result, measured, motion(result, times, best))
    adjust(result)
    said(best)
  return result, motion(result, times, best)


def _thinned(model: pycolmap.Reconstruction, every: int) -> pycolmap.Reconstruction:
  """Returns a model with every so many of the pictures."""
  result = pycolmap.Reconstruction(model)
  for row, image in enumerate(registered(result)):
    if row % every:
      result.deregister_frame(image.frame_id)
  return result
