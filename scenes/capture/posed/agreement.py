"""Whether measured depth and known poses explain where pictures show the same things.

Points of one picture, lifted by its depth and moved by the poses, must land where the other picture
shows them. The same distance in pixels tells the unit of the depth and the convention of the poses
apart, which files often leave open. Shapes: M matches.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

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
_WORST = 0.05  # of the picture's width: 3 degrees in a phone's view, 10 cm at 2 m
# m: 7-Scenes and ScanNet; TUM; RealSense L515; Replica as NICE-SLAM renders it; 0.1 mm
_UNITS = (1e-3, 1 / 5000, 1 / 4000, 1 / 6553.5, 1e-4)


class _Matches(NamedTuple):
  """Things that both pictures of a pair show."""

  first: np.ndarray  # [M] index of the picture
  second: np.ndarray  # [M]
  start: np.ndarray  # [M, 2] pixel in the first
  depth: np.ndarray  # [M] in the first [unit of the depth pictures]
  pixel: np.ndarray  # [M, 2] in the second


def settled(known: KnownPoses, images: Sequence[Path]) -> tuple[KnownPoses, list[str]]:
  """Reads depth and poses as the pictures ask for.

  Args:
    known: Poses and depth pictures of keyframes.
    images: The keyframes, of the camera's size.

  Returns:
    The poses, perhaps in another convention and with another unit of depth, and what was changed.

  Raises:
    CaptureError: However they are read, depth and poses do not belong to the pictures.
  """
  if not known.depth_files:
    return known, []
  matches = _matches(known, images)
  if len(matches.first) < _FEWEST:
    return known, []
  own = _distance(known, matches, known.world_from_camera, known.depth_unit)
  best, words, distance = known, "", own
  for how, poses in _conventions(known.world_from_camera):
    for unit in {known.depth_unit, *_UNITS}:
      off = _distance(known, matches, poses, unit)
      if off < _CLEARLY * own and off < distance:
        best = dataclasses.replace(known, world_from_camera=poses, depth_unit=unit)
        if len(known.depth_poses):
          best = dataclasses.replace(best, depth_poses=dict(_conventions(known.depth_poses))[how])
        words, distance = f"depth in units of {1e3 * unit:.3g} mm and poses as {how}", off
  if distance > _WORST * known.camera.width:
    raise CaptureError(
      f"Poses and depth do not belong to the pictures: what one picture shows lies {distance:.0f} "
      "pixels off in the next (median); expected world-from-camera poses in metres, depth aligned "
      "with the pictures, and their camera's intrinsics."
    )
  if best is known:
    return known, []
  return best, [
    f"Read {words}: pictures then agree to {distance:.1f} pixels, as the format says only to "
    f"{min(own, 9999):.0f}."
  ]


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
