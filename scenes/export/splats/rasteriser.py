"""Composites 2D Gaussians front to back, and the derivatives of that, by tiles (numba).

  alpha_i = min(0.99, opacity_i exp(-d^T conic_i d / 2)),  colour = sum_i c_i alpha_i T_i,
  T_i = prod_(j < i) (1 - alpha_j), over the splats in the order of their depth.

Source: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, section 6
and appendix C. Shapes: N splats, H height, W width, E entries of all tiles.
"""

from typing import NamedTuple

import numba
import numpy as np

_TILE = 4  # edge of a tile [pixel]; chosen: splats are a pixel or two wide in small pictures
_FAINTEST = 1 / 255  # alpha below which a splat does not reach a pixel; as in the source
_FULLEST = 0.99  # largest alpha; as in the source
_DARKEST = 1e-4  # transmittance at which a pixel is full; as in the source


class Tiles(NamedTuple):
  """Which splats touch each tile, near ones first."""

  first: np.ndarray  # index of each tile's first entry in `members` [tiles + 1]
  members: np.ndarray  # splats [E]


@numba.njit(cache=True)
def _power(opacity):
  """Exponent at which a splat becomes too faint to be drawn."""
  return np.log(max(opacity / _FAINTEST, 1.0))


@numba.njit(cache=True)
def _powers(opacities):
  found = np.empty(len(opacities), np.float32)
  for splat, opacity in enumerate(opacities):
    found[splat] = _power(opacity)
  return found


@numba.njit(cache=True)
def _bounds(centres, conics, opacities, splat, width, height):
  """First and last tile (x, y) that a splat reaches; an empty range where it reaches none."""
  a, b, c = conics[splat]
  reach = 2.0 * _power(opacities[splat])
  determinant = a * c - b * b
  if reach <= 0 or determinant <= 0:
    return 0, -1, 0, -1
  half_x, half_y = np.sqrt(reach * c / determinant), np.sqrt(reach * a / determinant)
  x, y = centres[splat]
  if x + half_x < 0 or y + half_y < 0 or x - half_x > width or y - half_y > height:
    return 0, -1, 0, -1
  last_x, last_y = (width - 1) // _TILE, (height - 1) // _TILE
  return (
    max(0, int((x - half_x) // _TILE)),
    min(last_x, int((x + half_x) // _TILE)),
    max(0, int((y - half_y) // _TILE)),
    min(last_y, int((y + half_y) // _TILE)),
  )


@numba.njit(cache=True)
def _assign(centres, conics, opacities, order, width, height):
  columns, rows = (width - 1) // _TILE + 1, (height - 1) // _TILE + 1
  first = np.zeros(columns * rows + 1, np.int64)
  for splat in order:
    left, right, top, bottom = _bounds(centres, conics, opacities, splat, width, height)
    for row in range(top, bottom + 1):
      for column in range(left, right + 1):
        first[row * columns + column + 1] += 1
  first = np.cumsum(first)
  members = np.empty(first[-1], np.int64)
  used = first[:-1].copy()
  for splat in order:
    left, right, top, bottom = _bounds(centres, conics, opacities, splat, width, height)
    for row in range(top, bottom + 1):
      for column in range(left, right + 1):
        tile = row * columns + column
        members[used[tile]] = splat
        used[tile] += 1
  return first, members


def assign(
  centres: np.ndarray,
  conics: np.ndarray,
  opacities: np.ndarray,
  depths: np.ndarray,
  *,
  width: int,
  height: int,
) -> Tiles:
  """Sorts splats with a positive depth [N] by it and lists them for each tile that they reach."""
  ahead = np.flatnonzero(depths > 0)
  order = ahead[np.argsort(depths[ahead], kind="stable")]
  return Tiles(*_assign(centres, conics, opacities, order, width, height))


@numba.njit(cache=True, fastmath=True)
def _exponent(centres, conics, splat, x, y):
  """Offset of a pixel from a splat's centre, and the negative exponent of the Gaussian there."""
  dx, dy = x - centres[splat, 0], y - centres[splat, 1]
  power = 0.5 * (conics[splat, 0] * dx * dx + conics[splat, 2] * dy * dy)
  return dx, dy, power + conics[splat, 1] * dx * dy


@numba.njit(cache=True, fastmath=True)
def composite(first, members, centres, conics, opacities, colors, width, height):
  """Draws a picture.

  Returns:
    Colour [H, W, 3], transmittance that is left [H, W], and the number of the tile's splats that
    were looked at [H, W].
  """
  image = np.zeros((height, width, 3), colors.dtype)
  left = np.ones((height, width), colors.dtype)
  looked = np.zeros((height, width), np.int64)
  columns, faintest = (width - 1) // _TILE + 1, _powers(opacities)
  for row in range(height):
    for column in range(width):
      tile = (row // _TILE) * columns + column // _TILE
      light = 1.0
      entry = first[tile]
      while entry < first[tile + 1] and light > _DARKEST:
        splat = members[entry]
        power = _exponent(centres, conics, splat, column + 0.5, row + 0.5)[2]
        if power < faintest[splat]:
          alpha = min(_FULLEST, opacities[splat] * np.exp(-power))
          for k in range(3):
            image[row, column, k] += light * alpha * colors[splat, k]
          light *= 1 - alpha
        entry += 1
      left[row, column] = light
      looked[row, column] = entry - first[tile]
  return image, left, looked


@numba.njit(cache=True, fastmath=True)
def composite_backward(
  first, members, centres, conics, opacities, colors, width, height, left, looked, slope
):
  """Returns the derivatives of a loss by the splats' values.

  Args:
    first, members, centres, conics, opacities, colors, width, height: As given to `composite`.
    left, looked: What `composite` returned.
    slope: Derivative of the loss by the picture [H, W, 3].

  Returns:
    Derivatives by centres [N, 2], conics [N, 3], opacities [N] and colours [N, 3].
  """
  by_centre, by_conic = np.zeros_like(centres), np.zeros_like(conics)
  by_opacity, by_color = np.zeros_like(opacities), np.zeros_like(colors)
  columns, faintest = (width - 1) // _TILE + 1, _powers(opacities)
  for row in range(height):
    for column in range(width):
      tile = (row // _TILE) * columns + column // _TILE
      light = left[row, column]
      behind = np.zeros(3, colors.dtype)  # light that comes from the splats behind
      for entry in range(first[tile] + looked[row, column] - 1, first[tile] - 1, -1):
        splat = members[entry]
        dx, dy, power = _exponent(centres, conics, splat, column + 0.5, row + 0.5)
        if power >= faintest[splat]:
          continue
        value = np.exp(-power)
        alpha = min(_FULLEST, opacities[splat] * value)
        before = light / (1 - alpha)
        by_alpha = 0.0
        for k in range(3):
          by_color[splat, k] += slope[row, column, k] * before * alpha
          by_alpha += slope[row, column, k] * (before * colors[splat, k] - behind[k] / (1 - alpha))
          behind[k] += before * alpha * colors[splat, k]
        light = before
        if alpha >= _FULLEST:
          continue
        by_opacity[splat] += by_alpha * value
        by_power = -by_alpha * alpha
        by_conic[splat, 0] += 0.5 * by_power * dx * dx
        by_conic[splat, 1] += by_power * dx * dy
        by_conic[splat, 2] += 0.5 * by_power * dy * dy
        a, b, c = conics[splat]
        by_centre[splat, 0] -= by_power * (a * dx + b * dy)
        by_centre[splat, 1] -= by_power * (b * dx + c * dy)
  return by_centre, by_conic, by_opacity, by_color
