"""Moves a point's observations to where patches of its pictures agree, by least squares.

A detector finds a spot of two pictures to half a pixel; what surrounds it tells to a tenth where
the spot of one lies in the other. One observation of a point is the template, and the others go to
where a picture shows it, bent by an affine map and changed by a gain and an offset. Source: Gruen
1985, Adaptive least squares correlation. Shapes: K observations, S samples along a patch's edge.
"""

import functools
import os
from collections import defaultdict
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numba
import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap

_HALF = 7  # samples from a patch's middle to its edge
_REACH = 4.0  # from there to the edge, times a feature's scale: two thirds of its descriptor's
_WINDOW = 0.6  # deviation of the samples' weights, times the way to the edge
_LEVELS = 4  # of a pyramid
_BLUR = 0.8  # of its first, deviation [pixel]: places between pixels of sharper ones are biased
_MEMORY = 1 << 30  # bytes of pyramids that are held; chosen
_LEAST_HELD = 64  # of them, chosen
_ROUNDS = 12  # of the search
_SETTLED = 0.02  # step that ends it [sample]
_FARTHEST = 3.0  # from the detector's place [sample]
_VAGUEST = 0.15  # standard deviation of a place [sample]
_LEAST_ALIKE = 0.8  # correlation of the template and what is found
_MOST_BENT = 0.5  # change of the affine map that the features' shapes give, relative


class Observation(NamedTuple):
  """Of a point in a picture."""

  image: int  # id of the picture
  row: int  # of its points2D


class _Features(NamedTuple):
  """Places and shapes of features."""

  places: np.ndarray  # float64 [K, 2], pixel
  shapes: np.ndarray  # float64 [K, 2, 2], pixel: where the axes of a feature's own frame point

  def of(self, rows: list[int]) -> "_Features":
    return _Features(self.places[rows], self.shapes[rows])


@numba.njit(cache=True)
def _value(image, x, y):
  """Brightness at a place, whose first pixel's middle is at 0.5; NaN outside of the picture."""
  height, width = image.shape
  x, y = x - 0.5, y - 0.5
  i, j = int(np.floor(y)), int(np.floor(x))
  if i < 0 or j < 0 or i + 1 >= height or j + 1 >= width:
    return np.nan
  v, u = y - i, x - j
  above = (1 - u) * image[i, j] + u * image[i, j + 1]
  below = (1 - u) * image[i + 1, j] + u * image[i + 1, j + 1]
  return (1 - v) * above + v * below


@numba.njit(cache=True)
def _cut(image, middle, steps, patch):
  """Fills a patch [S, S] with what is around a place; false where it reaches out of the picture."""
  half = len(patch) // 2
  for a in range(len(patch)):
    for b in range(len(patch)):
      u, v = b - half, a - half
      x = middle[0] + steps[0, 0] * u + steps[0, 1] * v
      y = middle[1] + steps[1, 0] * u + steps[1, 1] * v
      patch[a, b] = _value(image, x, y)
      if not np.isfinite(patch[a, b]):
        return False
  return True


@numba.njit(cache=True)
def _find(template, weights, image, place, steps):
  """Finds a template's middle in another picture, from a place and steps that are changed to it.

  Args:
    template: [S, S].
    weights: Of its samples [S, S].
    image: The other picture.
    place: Of the template's middle [2].
    steps: Of one sample to the right and of one down [2, 2].

  Returns:
    Whether it is found, as alike and as exactly as it must be.
  """
  half = len(template) // 2
  start, bend = place.copy(), steps.copy()
  spacing = np.sqrt(abs(bend[0, 0] * bend[1, 1] - bend[0, 1] * bend[1, 0]))
  gain, offset = 1.0, 0.0
  row, sums = np.empty(8), np.empty(5)
  for _ in range(_ROUNDS):
    curvature, slope, total, square = np.zeros((8, 8)), np.zeros(8), 0.0, 0.0
    sums[:] = 0.0
    for a in range(len(template)):
      for b in range(len(template)):
        u, v = b - half, a - half
        x = place[0] + steps[0, 0] * u + steps[0, 1] * v
        y = place[1] + steps[1, 0] * u + steps[1, 1] * v
        value, wanted, weight = _value(image, x, y), template[a, b], weights[a, b]
        along_x = gain * (_value(image, x + 0.5, y) - _value(image, x - 0.5, y))
        along_y = gain * (_value(image, x, y + 0.5) - _value(image, x, y - 0.5))
        if not np.isfinite(value + along_x + along_y):
          return False
        error = wanted - (gain * value + offset)
        row[0], row[1], row[2], row[3] = along_x, along_y, along_x * u, along_x * v
        row[4], row[5], row[6], row[7] = along_y * u, along_y * v, value, 1.0
        for i in range(8):
          slope[i] += weight * row[i] * error
          for j in range(i + 1):
            curvature[i, j] += weight * row[i] * row[j]
        total += weight
        square += weight * error * error
        sums[0] += weight * wanted
        sums[1] += weight * value
        sums[2] += weight * wanted * wanted
        sums[3] += weight * value * value
        sums[4] += weight * wanted * value
    for i in range(8):
      for j in range(i):
        curvature[j, i] = curvature[i, j]
      curvature[i, i] = (1 + 1e-6) * curvature[i, i] + 1e-9  # plain patches have no inverse
    sums /= total
    spread = (sums[2] - sums[0] ** 2) * (sums[3] - sums[1] ** 2)
    if spread <= 0:
      return False
    inverse = np.linalg.inv(curvature)
    step = inverse @ slope
    place += step[:2]
    steps += step[2:6].reshape(2, 2)
    gain, offset = gain + step[6], offset + step[7]
    if not gain > 0:
      return False
    if np.hypot(step[0], step[1]) < _SETTLED * spacing:
      alike = (sums[4] - sums[0] * sums[1]) / np.sqrt(spread)
      bent = np.sqrt(((steps - bend) ** 2).sum() / (bend**2).sum())
      deviation = np.sqrt(square / total * max(inverse[0, 0], inverse[1, 1]))
      far = np.hypot(place[0] - start[0], place[1] - start[1])
      return (
        alike >= _LEAST_ALIKE
        and bent <= _MOST_BENT
        and deviation <= _VAGUEST * spacing
        and far <= _FARTHEST * spacing
      )
  return False


@numba.njit(cache=True)
def _scale(shape):
  """Deviation of a feature's blob [pixel]."""
  return np.sqrt(abs(shape[0, 0] * shape[1, 1] - shape[0, 1] * shape[1, 0]))


@numba.njit(cache=True, nogil=True)
def _find_all(pyramid, places, shapes, other, other_places, other_shapes, weights):
  """Moves features of a picture to where it shows their templates of another one.

  Args:
    pyramid: Levels of the picture of the templates.
    places: Of the templates [K, 2].
    shapes: Of theirs [K, 2, 2].
    other: Levels of the other picture.
    other_places: Of the features there [K, 2], moved where they are found.
    other_shapes: Of theirs [K, 2, 2].
    weights: Of a patch's samples [S, S].

  Returns:
    Which were found, bool [K].
  """
  found = np.zeros(len(places), np.bool_)
  patch = np.empty_like(weights)
  for k in range(len(places)):
    scale, other_scale = _scale(shapes[k]), _scale(other_shapes[k])
    if not min(scale, other_scale) > 0:
      continue
    spacing = max(_REACH / _HALF, 1 / min(scale, other_scale))  # samples are a pixel apart at least
    level = min(max(int(np.log2(spacing * scale)), 0), len(pyramid) - 1)
    shrink = 0.5**level
    if not _cut(pyramid[level], places[k] * shrink, shapes[k] * spacing * shrink, patch):
      continue
    level = min(max(int(np.log2(spacing * other_scale)), 0), len(other) - 1)
    shrink = 0.5**level
    place, steps = other_places[k] * shrink, other_shapes[k] * spacing * shrink
    if _find(patch, weights, other[level], place, steps):
      found[k] = True
      other_places[k] = place / shrink
  return found


def _pyramid(path: Path) -> tuple[np.ndarray, ...]:
  """A picture's brightness, blurred, and halved again and again: uint8 [H, W] each."""
  image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
  if image is None:
    raise ValueError(f"The picture {path} cannot be read.")
  levels = [cv2.GaussianBlur(image, (0, 0), _BLUR)]
  for _ in range(_LEVELS - 1):
    height, width = (size // 2 for size in levels[-1].shape)
    even = levels[-1][: 2 * height, : 2 * width]  # so that every place is half of what it was
    levels.append(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA))
  return tuple(levels)


def _features(
  model: pycolmap.Reconstruction, database: Path, names: dict[int, str]
) -> dict[int, _Features]:
  """Features of pictures by their ids: where the model has them, shaped as detected."""
  found = {}
  with pycolmap.Database.open(str(database)) as db:
    for image in names:
      places = np.array([place.xy for place in model.images[image].points2D], np.float64)
      shapes = np.asarray(db.read_keypoints(image), np.float64)[:, 2:6]
      found[image] = _Features(places.reshape(-1, 2), shapes.reshape(-1, 2, 2))
  return found


def _held(model: pycolmap.Reconstruction) -> int:
  """How many pyramids of a model's pictures are held in memory."""
  largest = max(camera.width * camera.height for camera in model.cameras.values())
  return max(_LEAST_HELD, _MEMORY * 3 // (4 * largest))


def _in_blocks(pairs: Collection[tuple[int, int]], size: int) -> list[tuple[int, int]]:
  """Pairs of pictures in an order in which so many of either side come again and again."""
  row = {image: k for k, image in enumerate(sorted({image for pair in pairs for image in pair}))}
  return sorted(pairs, key=lambda pair: (row[pair[0]] // size, row[pair[1]] // size, pair))


def align(
  model: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  *,
  report: Progress = no_progress,
) -> list[Observation]:
  """Moves all observations of a model's points but one of each, in place.

  The one that is largest in its picture is the template of a point's others.

  Args:
    model: Poses, and points as they were detected.
    database: With the features of its pictures.
    images_folder: Where the pictures lie.
    report: Called with the fraction done and a text.

  Returns:
    The observations that were not found: they are where they were.

  Raises:
    ValueError: A picture cannot be read.
  """
  names = {i: image.name for i, image in model.images.items() if image.has_pose}
  features = _features(model, database, names)
  pairs = defaultdict[tuple[int, int], list[tuple[int, int]]](list)
  for point in model.points3D.values():
    seen = [Observation(e.image_id, e.point2D_idx) for e in point.track.elements]
    largest = max(seen, key=lambda o: _scale(features[o.image].shapes[o.row]))
    for one in seen:
      if one is not largest:
        pairs[largest.image, one.image].append((largest.row, one.row))
  held = _held(model)
  pyramid = functools.lru_cache(held)(lambda image: _pyramid(images_folder / names[image]))
  along = np.exp(-0.5 * (np.arange(-_HALF, _HALF + 1) / (_WINDOW * _HALF)) ** 2)

  def find(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rows, others = zip(*pairs[pair], strict=True)
    of_template, of_other = features[pair[0]].of(list(rows)), features[pair[1]].of(list(others))
    levels, other_levels = (pyramid(image) for image in pair)
    found = _find_all(levels, *of_template, other_levels, *of_other, np.outer(along, along))
    return of_other.places, found

  lost = []
  with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
    order = _in_blocks(pairs, held // 2)
    for done, (pair, (places, found)) in enumerate(zip(order, pool.map(find, order), strict=True)):
      shown = model.images[pair[1]].points2D
      for (_, row), place, is_found in zip(pairs[pair], places, found, strict=True):
        if is_found:
          shown[row].xy = place
        else:
          lost.append(Observation(pair[1], row))
      report((done + 1) / len(order), f"aligned patches of {done + 1} of {len(order)} pairs")
  return lost
