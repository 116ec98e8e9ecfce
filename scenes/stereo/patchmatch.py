"""Searches the plane at every pixel that other pictures show alike.

Sources: Bleyer et al. 2011, "PatchMatch stereo" (planes that spread to pixels beside); Galliani et
al. 2015, "Massively parallel multiview stereopsis by surface normal diffusion" (in the order of a
chequerboard, judged by the best few of many pictures).
Shapes: H height, W width, K other pictures, h rows and w columns of pixels that look for a plane.
"""

import dataclasses
from typing import NamedTuple

import numba
import numpy as np

BEST = 2  # others that count: something may stand before the rest
_HALF, _STEP = 5, 2  # of a patch [pixel]: half of it, and every so many are compared
_STEEPEST = -0.1  # about the cosine between a plane's normal and the ray
_ANYWHERE = 3  # rounds in which a plane is drawn from all of the range, too
_TILT, _MOVE = 0.5, 0.1  # what planes vary by at first, half of it every round


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchSettings:
  """Settings of the search; chosen, not tuned."""

  stride: int = 2
  """Every so many pixels along rows and columns one looks for its plane."""
  rounds: int = 6
  """Of trying what pixels beside found."""
  least_contrast: float = 0.008
  """Standard deviation of a patch, of white: with less it is noise."""


class Others(NamedTuple):
  """Pictures that a picture is compared with, of one pinhole camera."""

  pictures: np.ndarray  # float32 [K, H, W] in [0, 1]
  rotations: np.ndarray  # float32 [K, 3, 3], other from picture
  translations: np.ndarray  # float32 [K, 3]


@numba.njit(fastmath=True, cache=True)
def _likeness(picture, others, lens, least_contrast, x, y, depth, nx, ny, nz):
  """Mean correlation with the two others that show a plane most alike, in [-1, 1]; -1: none."""
  fx, fy, cx, cy = lens
  height, width = picture.shape
  rx, ry = (x - cx) / fx, (y - cy) / fy
  facing = nx * rx + ny * ry + nz
  if facing > _STEEPEST:
    return -1.0
  total, square, count = 0.0, 0.0, 0
  for j in range(-_HALF, _HALF + 1, _STEP):
    for i in range(-_HALF, _HALF + 1, _STEP):
      a = picture[min(max(y + j, 0), height - 1), min(max(x + i, 0), width - 1)]
      total += a
      square += a * a
      count += 1
  contrast = least_contrast * least_contrast
  variance = square / count - (total / count) ** 2
  if variance < contrast:
    return -1.0
  mx, my, mz = nx / (facing * depth), ny / (facing * depth), nz / (facing * depth)
  first, second = -1.0, -1.0
  for k in range(len(others.pictures)):
    other, r, t = others.pictures[k], others.rotations[k], others.translations[k]
    # x' ~ (R + t m^T) x for points x of the plane m . x = 1
    h00, h01, h02 = r[0, 0] + t[0] * mx, r[0, 1] + t[0] * my, r[0, 2] + t[0] * mz
    h10, h11, h12 = r[1, 0] + t[1] * mx, r[1, 1] + t[1] * my, r[1, 2] + t[1] * mz
    h20, h21, h22 = r[2, 0] + t[2] * mx, r[2, 1] + t[2] * my, r[2, 2] + t[2] * mz
    sum_b, sum_bb, sum_ab = 0.0, 0.0, 0.0
    inside = True
    for j in range(-_HALF, _HALF + 1, _STEP):
      v = ry + j / fy
      for i in range(-_HALF, _HALF + 1, _STEP):
        u = rx + i / fx
        z = h20 * u + h21 * v + h22
        px = fx * (h00 * u + h01 * v + h02) / z + cx
        py = fy * (h10 * u + h11 * v + h12) / z + cy
        if not (z > 1e-6 and 0 <= px < width - 1.001 and 0 <= py < height - 1.001):
          inside = False
          break
        ix, iy = int(px), int(py)
        ax, ay = px - ix, py - iy
        b = (1 - ay) * ((1 - ax) * other[iy, ix] + ax * other[iy, ix + 1])
        b += ay * ((1 - ax) * other[iy + 1, ix] + ax * other[iy + 1, ix + 1])
        a = picture[min(max(y + j, 0), height - 1), min(max(x + i, 0), width - 1)]
        sum_b += b
        sum_bb += b * b
        sum_ab += a * b
      if not inside:
        break
    if not inside:
      continue
    spread = sum_bb / count - (sum_b / count) ** 2
    if spread < 0.25 * contrast:  # half of the contrast: blurred, or of a lower exposure
      continue
    found = (sum_ab / count - total * sum_b / (count * count)) / np.sqrt(variance * spread)
    if found > first:
      first, second = found, first
    elif found > second:
      second = found
  return 0.5 * (first + second)


@numba.njit(fastmath=True, cache=True)
def _facing(nx, ny, nz, rx, ry):
  """A unit normal towards the camera."""
  length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
  length = -length if nx * rx + ny * ry + nz > 0 else length
  return nx / length, ny / length, nz / length


@numba.njit(parallel=True, fastmath=True, cache=True)
def _improve(picture, others, lens, near, far, stride, turn, seed, least_contrast, planes, best):
  """One round: every pixel takes the best of its plane, those beside and what varies it."""
  fx, fy, cx, cy = lens
  rows, columns = best.shape
  scale = 0.5 ** max(turn - 1, 0)
  for colour in range(2):
    for row in numba.prange(rows):
      np.random.seed(seed + (turn * 2 + colour) * rows + row)
      for column in range((row + colour) % 2, columns, 2):
        x, y = column * stride, row * stride
        rx, ry = (x - cx) / fx, (y - cy) / fy
        score = best[row, column]
        depth, nx, ny, nz = planes[row, column]
        if turn == 0:
          score = _likeness(picture, others, lens, least_contrast, x, y, depth, nx, ny, nz)
        for k in range(0 if turn == 0 else 8):
          reach = 1 if k < 4 else 5
          r = row + (reach if k % 4 == 0 else -reach if k % 4 == 1 else 0)
          c = column + (reach if k % 4 == 2 else -reach if k % 4 == 3 else 0)
          if r < 0 or c < 0 or r >= rows or c >= columns:
            continue
          d, a, b, e = planes[r, c]
          facing = a * rx + b * ry + e
          if facing > _STEEPEST:
            continue
          d *= (a * (c * stride - cx) / fx + b * (r * stride - cy) / fy + e) / facing
          if d < near or d > far:
            continue
          found = _likeness(picture, others, lens, least_contrast, x, y, d, a, b, e)
          if found > score:
            score, depth, nx, ny, nz = found, d, a, b, e
        for k in range(3):
          d, a, b, e = depth, nx, ny, nz
          if k == 0 and turn < _ANYWHERE:
            d = 1 / (1 / far + np.random.random() * (1 / near - 1 / far))
            a, b, e = np.random.normal(), np.random.normal(), np.random.normal()
          if k == 2 or (k == 0 and turn >= _ANYWHERE):
            d = depth * (1 + _MOVE * scale * np.random.normal())
          if k == 1 or (k == 0 and turn >= _ANYWHERE):
            a += _TILT * scale * np.random.normal()
            b += _TILT * scale * np.random.normal()
            e += _TILT * scale * np.random.normal()
          a, b, e = _facing(a, b, e, rx, ry)
          if d < near or d > far:
            continue
          found = _likeness(picture, others, lens, least_contrast, x, y, d, a, b, e)
          if found > score:
            score, depth, nx, ny, nz = found, d, a, b, e
        best[row, column] = score
        planes[row, column, 0] = depth
        planes[row, column, 1] = nx
        planes[row, column, 2] = ny
        planes[row, column, 3] = nz


def search(
  picture: np.ndarray,
  others: Others,
  lens: tuple[float, float, float, float],
  *,
  first: np.ndarray,
  near: float,
  far: float,
  settings: SearchSettings,
  seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
  """Searches depth at every `stride`-th pixel of a picture.

  Args:
    picture: Grey, float32 [H, W] in [0, 1].
    others: What it is compared with; at least two.
    lens: Focal lengths and principal point [pixel], where a pixel's index is its centre.
    first: Depths to begin with [h, w].
    near: Least depth.
    far: Greatest depth.
    settings: Settings.
    seed: Of the planes that are tried.

  Returns:
    Depth float32 [h, w] and likeness float32 [h, w], the mean correlation with the two others that
    show the plane most alike; -1 where nothing was compared.
  """
  planes = np.zeros((*first.shape, 4), np.float32)
  planes[..., 0], planes[..., 3] = first, -1.0
  best = np.full(first.shape, -1, np.float32)
  numbers = tuple(np.float32(value) for value in lens)
  for turn in range(settings.rounds + 1):
    _improve(
      picture,
      others,
      numbers,
      np.float32(near),
      np.float32(far),
      settings.stride,
      turn,
      seed,
      np.float32(settings.least_contrast),
      planes,
      best,
    )
  return planes[..., 0], best
