"""Matches along the geometry of two pictures: more of them than descriptors alone give.

Once a pair's geometry is known, a feature's partner lies on its epipolar line (or, where a plane or
a turn explains the pair, at one place), so that its descriptor is compared with those there alone:
the ratio test then fails no more for what looks alike elsewhere. Source: COLMAP's guided matching,
whose thresholds these are; theirs compares all descriptors of both pictures and takes ten times as
long.
"""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np

from nerf2real.scenes.colmap import pycolmap

MAX_ERROR = 4.0  # pixel from the line or place; COLMAP
MAX_RATIO = 0.8  # of the angles to the best and the second best; COLMAP
MAX_ANGLE = 0.7  # rad between two descriptors; COLMAP
_LENGTH = 512.0  # of a descriptor in a database, whose numbers are bytes
_CONFIGURATIONS = pycolmap.TwoViewGeometryConfiguration
_LINES = (_CONFIGURATIONS.CALIBRATED, _CONFIGURATIONS.UNCALIBRATED)
_PLACES = (
  _CONFIGURATIONS.PLANAR,
  _CONFIGURATIONS.PANORAMIC,
  _CONFIGURATIONS.PLANAR_OR_PANORAMIC,
)


class Features(NamedTuple):
  """Of one picture."""

  places: np.ndarray  # float32 [N, 2], pixel
  descriptors: np.ndarray  # float32 [N, 128], of length 1


def match(one: Features, two: Features, geometry: pycolmap.TwoViewGeometry) -> np.ndarray | None:
  """Matches the features of two pictures along their geometry.

  Args:
    one: Of the first picture.
    two: Of the second picture.
    geometry: Of the pair, by its configuration a fundamental matrix or a homography.

  Returns:
    Rows of features that belong together, uint32 [M, 2]; None where the geometry is neither.
  """
  is_line = geometry.config in _LINES
  matrix = geometry.F if is_line else geometry.H if geometry.config in _PLACES else None
  if matrix is None:
    return None
  best = _best(*one, *two, np.asarray(matrix, np.float32), is_line)
  return best.astype(np.uint32)


def match_pairs(database: Path, pairs: Iterable[tuple[int, int]]) -> None:
  """Adds to the matches of verified pairs those along the geometry that was found.

  A pair stays as it is where it has no geometry, where this finds no more, and where it has matches
  that descriptors alone had not given: then it was here before.

  Args:
    database: With features, matches and two-view geometries.
    pairs: Of picture ids.
  """
  with pycolmap.Database.open(str(database)) as db:
    plain = {pair: db.read_two_view_geometry(*pair) for pair in pairs if _is_plain(db, *pair)}
    features = {i: _features_of(db, i) for i in {i for pair in plain for i in pair}}
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
      found = pool.map(lambda p: match(features[p[0]], features[p[1]], plain[p]), plain)
      for (pair, geometry), rows in zip(plain.items(), found, strict=True):
        if rows is not None and len(rows) > len(geometry.inlier_matches):
          geometry.inlier_matches = rows
          db.update_two_view_geometry(*pair, geometry)


def _is_plain(db: pycolmap.Database, one: int, two: int) -> bool:
  """Whether a pair was verified, and has matches by descriptors alone."""
  if not db.exists_two_view_geometry(one, two):
    return False
  inliers = db.read_two_view_geometry(one, two).inlier_matches.astype(np.int64)
  matches = db.read_matches(one, two).astype(np.int64)
  number = np.array([1 << 32, 1])
  return len(inliers) > 0 and bool(np.isin(inliers @ number, matches @ number).all())


def _features_of(db: pycolmap.Database, image: int) -> Features:
  places = np.ascontiguousarray(db.read_keypoints(image)[:, :2], np.float32)
  descriptors = db.read_descriptors(image).data.astype(np.float32) / _LENGTH
  return Features(places, descriptors)


@numba.njit(nogil=True, cache=True, fastmath=True)
def _best(places1, descriptors1, places2, descriptors2, matrix, is_line):
  """Pairs of features that are each other's best along a geometry, int64 [M, 2]."""
  count1, count2 = len(places1), len(places2)
  error = np.float32(MAX_ERROR * MAX_ERROR)
  first1, second1 = np.zeros(count1, np.float32), np.zeros(count1, np.float32)
  first2, second2 = np.zeros(count2, np.float32), np.zeros(count2, np.float32)
  of1, of2 = np.full(count1, -1), np.full(count2, -1)
  x, y = places2[:, 0].copy(), places2[:, 1].copy()
  slopes = np.empty(count2, np.float32)  # squared, of the features' lines in the first picture
  for j in range(count2):
    a = matrix[0, 0] * x[j] + matrix[1, 0] * y[j] + matrix[2, 0]
    b = matrix[0, 1] * x[j] + matrix[1, 1] * y[j] + matrix[2, 1]
    slopes[j] = a * a + b * b
  near = np.empty(count2, np.bool_)
  for i in range(count1):
    u, v = places1[i]
    a = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
    b = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]
    c = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
    if is_line:  # Sampson's distance
      slope = a * a + b * b
      for j in range(count2):
        product = a * x[j] + b * y[j] + c
        near[j] = product * product <= error * (slope + slopes[j])
    else:
      a, b = a / c, b / c
      for j in range(count2):
        near[j] = (x[j] - a) * (x[j] - a) + (y[j] - b) * (y[j] - b) <= error
    for j in range(count2):
      if near[j]:
        alike = np.float32(0.0)
        for k in range(descriptors1.shape[1]):
          alike += descriptors1[i, k] * descriptors2[j, k]
        if alike > first1[i]:
          first1[i], second1[i], of1[i] = alike, first1[i], j
        elif alike > second1[i]:
          second1[i] = alike
        if alike > first2[j]:
          first2[j], second2[j], of2[j] = alike, first2[j], i
        elif alike > second2[j]:
          second2[j] = alike
  result = np.empty((min(count1, count2), 2), np.int64)
  found = 0
  for i in range(count1):
    j = of1[i]
    if j < 0 or of2[j] != i:
      continue
    if _is_clear(first1[i], second1[i]) and _is_clear(first2[j], second2[j]):
      result[found, 0], result[found, 1] = i, j
      found += 1
  return result[:found]


@numba.njit(nogil=True, cache=True, inline="always")
def _is_clear(first, second):
  """Whether the best descriptor is near, and clearly nearer than the second."""
  angle = np.arccos(min(first, np.float32(1.0)))
  return angle <= MAX_ANGLE and angle < MAX_RATIO * np.arccos(min(second, np.float32(1.0)))
