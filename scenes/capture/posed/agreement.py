"""Whether measured depth and known poses explain where pictures show the same things.

Points of one picture, lifted by its depth and moved by the poses, must land where the other picture
shows them. The same distance in pixels tells the unit of the depth and the convention of the poses
apart, which files often leave open. Poses of structure from motion have a metre of their own: then
the unit under which they fit best tells how large they are by the depth. Shapes: M matches.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.capture.posed.known_poses import KnownPoses

_PAIRS = 24  # of pictures; chosen: some thousand matches in seconds
_STEP = 2  # keyframes from one picture of a pair to the other: they share most and have parallax
_FEATURES = 1000  # of a picture
_RATIO = 0.75  # of nearest to second-nearest descriptor; Lowe 2004, section 7.1: 0.8
_FEWEST = 100  # matches; fewer say nothing
_CLEARLY = 0.5  # another reading must be this much nearer than the format's own
_EXACT = 1.0  # pixel: what is no farther off needs no other reading; features err by half of it
_DRIFT = 0.05  # of a sensor's and a tracker's metre: less is no other unit; chosen
_WORST = 0.05  # of the picture's width: 3 degrees in a phone's view, 10 cm at 2 m
_FITS = 0.01  # of the width, of another unit than the format's; chosen: 20 times a drawn room's
# m: 7-Scenes and ScanNet; TUM; RealSense L515; Replica as NICE-SLAM renders it; 0.1 mm
_UNITS = (1e-3, 1 / 5000, 1 / 4000, 1 / 6553.5, 1e-4)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # of two left-handed frames makes right-handed ones
_ANY = np.geomspace(1e-2, 1e2, 52)  # times the format's unit: sizes of structure from motion


class _Matches(NamedTuple):
  """Things that both pictures of a pair show."""

  first: np.ndarray  # [M] index of the picture
  second: np.ndarray  # [M]
  start: np.ndarray  # [M, 2] pixel in the first
  depth: np.ndarray  # [M] in the first [unit of the depth pictures]
  pixel: np.ndarray  # [M, 2] in the second


class _Reading(NamedTuple):
  """One way to read poses and depth."""

  how: str  # the poses' convention
  unit: float  # of depth, in the poses' own
  distance: float  # median of what matches are off [pixel]

  def clearly_nearer(self, other: "_Reading") -> bool:
    """Whether it is to be preferred to one that should come first."""
    return other.distance > _EXACT and self.distance < _CLEARLY * other.distance


def settled(known: KnownPoses, images: Sequence[Path]) -> tuple[KnownPoses, list[str]]:
  """Reads depth and poses as the pictures ask for.

  Args:
    known: Poses and depth pictures of keyframes.
    images: The keyframes, of the camera's size.

  Returns:
    The poses, perhaps in another convention, with another unit of depth or of another size, and
    what was changed.

  Raises:
    CaptureError: However they are read, depth and poses do not belong to the pictures.
  """
  if not known.depth_files:
    return known, []
  matches = _matches(known, images)
  if len(matches.first) < _FEWEST:
    return known, []
  poses = dict(_conventions(known.world_from_camera))
  own, *others = (
    _Reading(how, unit, _distance(known, matches, poses[how], unit))
    for how in poses
    for unit in (known.depth_unit, *_UNITS)
  )
  if own.distance <= _EXACT:
    return known, []
  listed = min(others, key=lambda reading: reading.distance)
  best = listed if listed.clearly_nearer(own) else own
  free = min((_sized(known, matches, *of) for of in poses.items()), key=lambda r: r.distance)
  fits = free.clearly_nearer(best) and free.distance <= _FITS * known.camera.width
  fits = fits and abs(np.log(free.unit / best.unit)) > _DRIFT
  if fits and not known.names_unit:
    return _enlarged(known, free, own)
  switched = best.unit != known.depth_unit
  limit = _FITS if switched else _WORST
  if best.distance > limit * known.camera.width or (fits and switched):
    would = f" They would fit to {free.distance:.1f} pixels if {_size_words(known, free)}."
    raise CaptureError(
      f"Poses and depth do not belong to the pictures: what one picture shows lies "
      f"{min(best.distance, 9999):.0f} pixels off in the next (median); expected world-from-camera "
      "poses in metres, depth aligned with the pictures, and their camera's intrinsics."
      f"{would if fits else ''}"
    )
  if best is own:
    return known, []
  return _read_as(known, best.how, best.unit), [
    f"Read depth in units of {1e3 * best.unit:.3g} mm and poses as {best.how}: {_gain(best, own)}."
  ]


def _sized(known: KnownPoses, found: _Matches, how: str, poses: np.ndarray) -> _Reading:
  """The unit of any size under which a convention of the poses [N, 4, 4] fits best."""

  def off(unit: float) -> float:
    return _distance(known, found, poses, unit)

  units = known.depth_unit * _ANY
  near = int(np.argmin([off(unit) for unit in units[1:-1]])) + 1
  ends = np.log(units[[near - 1, near + 1]])
  at = float(np.exp(minimize_scalar(lambda u: off(np.exp(u)), bounds=ends, method="bounded").x))
  return _Reading(how, at, off(at))


def _read_as(known: KnownPoses, how: str, unit: float, factor: float = 1.0) -> KnownPoses:
  """Poses of a convention, their lengths multiplied, with depth of a unit."""

  def read(poses: np.ndarray) -> np.ndarray:
    made = dict(_conventions(poses))[how].copy()
    made[:, :3, 3] *= factor
    return made

  moved = dataclasses.replace(
    known, world_from_camera=read(known.world_from_camera), depth_unit=unit
  )
  if len(known.depth_poses):
    moved = dataclasses.replace(moved, depth_poses=read(known.depth_poses))
  return moved


def _enlarged(known: KnownPoses, free: _Reading, own: _Reading) -> tuple[KnownPoses, list[str]]:
  """Poses of the size that measured depth gives them, and what was changed."""
  sized = _read_as(known, free.how, known.depth_unit, known.depth_unit / free.unit)
  convention = "" if free.how == own.how else f", read as {free.how},"
  return sized, [
    f"The poses{convention} are not in the metres of the depth: {_size_words(known, free)}, "
    f"{_gain(free, own)}. So depth decides the metre, taken to be in units of "
    f"{1e3 * known.depth_unit:.3g} mm."
  ]


def _size_words(known: KnownPoses, free: _Reading) -> str:
  return f"their lengths are multiplied by {known.depth_unit / free.unit:.3g}"


def _gain(best: _Reading, own: _Reading) -> str:
  return (
    f"pictures then agree to {best.distance:.1f} pixels, as the format says only to "
    f"{min(own.distance, 9999):.0f}"
  )


def distances(readings: Sequence[KnownPoses], images: Sequence[Path]) -> list[float]:
  """Median distance [pixel] of measured depth in neighbouring pictures; NaN where nothing matches.

  Args:
    readings: The same pictures with several poses and lenses.
    images: The keyframes, of the cameras' size.
  """
  found = _matches(readings[0], images)
  if len(found.first) < _FEWEST:
    return [float("nan")] * len(readings)
  return [_distance(known, found, known.world_from_camera, known.depth_unit) for known in readings]


def _conventions(poses: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
  """Names and gives the readings of poses [N, 4, 4] that are in use."""
  flip = np.eye(4)
  flip[:3, :3] = OPENGL_FROM_OPENCV
  back = np.linalg.inv(poses)
  yield "world from camera", poses
  yield "camera from world", back
  yield "world from camera with OpenGL's axes", poses @ flip
  yield "camera from world with OpenGL's axes", np.linalg.inv(flip @ poses)
  yield "world from camera with mirrored y axes (ICL-NUIM)", _MIRROR @ poses @ _MIRROR


def _distance(known: KnownPoses, found: _Matches, poses: np.ndarray, unit: float) -> float:
  """Median distance [pixel] of lifted and moved points from where the second pictures show them."""
  points = known.camera.rays(found.start) * (found.depth * unit)[:, None]
  second_from_first = np.linalg.inv(poses[found.second]) @ poses[found.first]
  moved = np.einsum("mij,mj->mi", second_from_first[:, :3, :3], points)
  moved += second_from_first[:, :3, 3]
  off = np.full(len(points), np.inf)
  ahead = moved[:, 2] > 0.1 * np.linalg.norm(moved, axis=-1)
  off[ahead] = np.linalg.norm(known.camera.project(moved[ahead]) - found.pixel[ahead], axis=-1)
  return float(np.median(off))


def _matches(known: KnownPoses, images: Sequence[Path]) -> _Matches:
  """Matches pairs of keyframes where the first one has depth."""
  sift = cv2.SIFT.create(nfeatures=_FEATURES)  # type: ignore[attr-defined]
  count = len(images)
  starts = np.unique(np.linspace(0, max(count - _STEP - 1, 0), min(_PAIRS, count)).astype(int))
  rows: list[np.ndarray] = []
  for first in starts:
    second = min(first + _STEP, count - 1)
    (points, words), (others, theirs) = (_features(sift, images[k]) for k in (first, second))
    pairs = _mutual(words, theirs)
    if not len(pairs):
      continue
    pixel = points[pairs[:, 0]]
    depth = depth_pictures.at_pixels(known.depth_files[first], pixel, known.camera)
    good = depth > 0
    rows.append(
      np.column_stack(
        [np.full((len(pairs), 2), (first, second)), pixel, depth, others[pairs[:, 1]]]
      )[good]
    )
  found = np.concatenate(rows) if rows else np.zeros((0, 7))
  numbers = found[:, :2].astype(int)
  return _Matches(numbers[:, 0], numbers[:, 1], found[:, 2:4], found[:, 4], found[:, 5:7])


def _features(sift: cv2.SIFT, path: Path) -> tuple[np.ndarray, np.ndarray]:
  """Pixels [K, 2] and descriptors [K, 128] of a picture's features."""
  image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
  if image is None:
    raise CaptureError(f"{path} cannot be read as a picture.")
  points, words = sift.detectAndCompute(image, None)
  pixels = np.array([point.pt for point in points]).reshape(-1, 2) + 0.5
  return pixels, np.zeros((0, 128), np.float32) if words is None else words


def _mutual(words: np.ndarray, others: np.ndarray) -> np.ndarray:
  """Indices [K, 2] of descriptors that are each other's nearest and pass the ratio test."""
  if min(len(words), len(others)) < 2:
    return np.zeros((0, 2), int)
  matcher = cv2.BFMatcher()
  there = matcher.knnMatch(words, others, k=2)
  back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(others, words, k=1)}
  pairs = [
    (near.queryIdx, near.trainIdx)
    for near, next_nearest in there
    if near.distance < _RATIO * next_nearest.distance and back[near.trainIdx] == near.queryIdx
  ]
  return np.array(pairs, int).reshape(-1, 2)
