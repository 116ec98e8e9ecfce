"""Composites splats along the rays of a picture, and the derivatives of that, by tiles (numba).

  alpha_i = min(0.99, opacity_i exp(-E_i)),  colour = sum_i c_i alpha_i T_i,
  T_i = prod_(j < i) (1 - alpha_j), over the splats in the order of their depth along the ray

with E of `projection`. Tiles list their splats by the depths of the centres; a short buffer at each
pixel puts them into the order along its ray.

Sources: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, section 6
and appendix C; the order is that of Radl et al. 2024, StopThePop. Shapes: N splats, H height,
W width, E entries of all tiles, K splats that are drawn in all pixels.
"""

from typing import NamedTuple

import numba
import numpy as np

from nerf2real.scenes.export.splats.projection import FAINTEST, Bounds

_TILE = 2  # edge of a tile [pixel]; chosen: splats are a pixel or two wide in small pictures
_FULLEST = 0.99  # largest alpha; Kerbl et al.'s
_DARKEST = 0.005  # transmittance at which a pixel is full: MuJoCo Warp's
_WAITING = 24  # splats at a ray that wait for nearer ones; chosen: more change no picture


class Tiles(NamedTuple):
  """Which splats touch each tile, near ones first."""

  first: np.ndarray  # index of each tile's first entry in `members` [tiles + 1]
  members: np.ndarray  # splats [E]
  depths: np.ndarray  # of the centres [N] [m]


class Drawn(NamedTuple):
  """A picture, and what it is made of."""

  image: np.ndarray  # [H, W, 3]
  left: np.ndarray  # transmittance that is left [H, W]
  starts: np.ndarray  # index of each pixel's first splat in `hits` [H * W + 1]
  hits: np.ndarray  # splats as they follow on each pixel's ray [K]


@numba.njit(cache=True)
def _assign(boxes, order, width, height):
  columns, rows = (width - 1) // _TILE + 1, (height - 1) // _TILE + 1
  first = np.zeros(columns * rows + 1, np.int64)
  limits = np.empty((len(order), 4), np.int64)
  for index, splat in enumerate(order):
    left, right, top, bottom = boxes[splat]
    if right < 0 or bottom < 0 or left > width or top > height or right <= left or bottom <= top:
      limits[index] = 0, -1, 0, -1
      continue
    limits[index, 0] = int(max(left, 0) // _TILE)
    limits[index, 1] = int(min(right, width - 1) // _TILE)
    limits[index, 2] = int(max(top, 0) // _TILE)
    limits[index, 3] = int(min(bottom, height - 1) // _TILE)
    for row in range(limits[index, 2], limits[index, 3] + 1):
      for column in range(limits[index, 0], limits[index, 1] + 1):
        first[row * columns + column + 1] += 1
  first = np.cumsum(first)
  members = np.empty(first[-1], np.int64)
  used = first[:-1].copy()
  for index, splat in enumerate(order):
    for row in range(limits[index, 2], limits[index, 3] + 1):
      for column in range(limits[index, 0], limits[index, 1] + 1):
        tile = row * columns + column
        members[used[tile]] = splat
        used[tile] += 1
  return first, members


def assign(bounds: Bounds, *, width: int, height: int) -> Tiles:
  """Sorts splats with a positive depth by it and lists them for each tile that they reach."""
  ahead = np.flatnonzero(bounds.depths > 0)
  order = ahead[np.argsort(bounds.depths[ahead], kind="stable")]
  first, members = _assign(bounds.boxes, order, width, height)
  return Tiles(first, members, bounds.depths)


@numba.njit(cache=True, fastmath=True)
def _response(centres, conics, bends, splat, x, y):
  """Offset of a pixel from a splat's centre, exponent, and |w(q)|^2 / |w(0)|^2."""
  dx, dy = x - centres[splat, 0], y - centres[splat, 1]
  power = 0.5 * (conics[splat, 0] * dx * dx + conics[splat, 2] * dy * dy)
  power += conics[splat, 1] * dx * dy
  bend = 1 + dx * (2 * bends[splat, 0] + bends[splat, 2] * dx + 2 * bends[splat, 3] * dy)
  bend += dy * (2 * bends[splat, 1] + bends[splat, 4] * dy)
  bend = max(bend, 1e-12)
  return dx, dy, power / bend, bend


@numba.njit(cache=True, fastmath=True)
def _limits(opacities):
  """Exponents [N] at which splats become too faint to be drawn."""
  found = np.empty(len(opacities), np.float32)
  for splat, opacity in enumerate(opacities):
    found[splat] = np.log(max(opacity / FAINTEST, 1.0))
  return found


@numba.njit(cache=True, fastmath=True)
def _composite(first, members, depths, centres, conics, bends, opacities, colors, width, height):
  image = np.zeros((height, width, 3), colors.dtype)
  left = np.ones((height, width), colors.dtype)
  starts = np.zeros(height * width + 1, np.int64)
  hits = np.empty(16 * height * width, np.int32)
  columns, limits, count = (width - 1) // _TILE + 1, _limits(opacities), 0
  room = 4 * _WAITING
  waiting, alphas, reaches = np.empty(room, np.int32), np.empty(room), np.empty(room)
  for row in range(height):
    for column in range(width):
      tile = (row // _TILE) * columns + column // _TILE
      light, entry, head, end = 1.0, first[tile], 0, 0  # from head to end they wait, near to far
      while light > _DARKEST:
        if entry < first[tile + 1]:
          splat = members[entry]
          entry += 1
          dx, dy, power, bend = _response(centres, conics, bends, splat, column + 0.5, row + 0.5)
          if power >= limits[splat]:
            continue
          if end == room:
            for k in range(head, end):
              waiting[k - head], alphas[k - head] = waiting[k], alphas[k]
              reaches[k - head] = reaches[k]
            head, end = 0, end - head
          reach = depths[splat] * (1 + bends[splat, 0] * dx + bends[splat, 1] * dy) / bend
          place = end
          while place > head and reaches[place - 1] > reach:
            waiting[place], alphas[place] = waiting[place - 1], alphas[place - 1]
            reaches[place] = reaches[place - 1]
            place -= 1
          waiting[place], reaches[place] = splat, reach
          alphas[place] = min(_FULLEST, opacities[splat] * np.exp(-power))
          end += 1
          if end - head <= _WAITING:
            continue
        if head == end:
          break
        splat, alpha = waiting[head], alphas[head]
        head += 1
        for k in range(3):
          image[row, column, k] += light * alpha * colors[splat, k]
        light *= 1 - alpha
        if count == len(hits):
          more = np.empty(2 * len(hits), np.int32)
          more[:count] = hits
          hits = more
        hits[count] = splat
        count += 1
      left[row, column] = light
      starts[row * width + column + 1] = count
  return image, left, starts, hits[:count]


def composite(tiles: Tiles, gaussians: tuple[np.ndarray, ...], *, width: int, height: int) -> Drawn:
  """Draws a picture of the splats of `projection.Projected`."""
  inputs = (*tiles, *gaussians, width, height)
  return Drawn(*_composite(*inputs))  # type: ignore[call-arg]


@numba.njit(cache=True, fastmath=True)
def _backward(centres, conics, bends, opacities, colors, left, starts, hits, slope):
  by_centre, by_conic, by_bend = np.zeros_like(centres), np.zeros_like(conics), np.zeros_like(bends)
  by_opacity, by_color = np.zeros_like(opacities), np.zeros_like(colors)
  height, width = left.shape
  behind = np.zeros(3)  # light that comes from the splats behind
  for row in range(height):
    for column in range(width):
      pixel, light = row * width + column, left[row, column]
      behind[:] = 0.0
      for hit in range(starts[pixel + 1] - 1, starts[pixel] - 1, -1):
        splat = hits[hit]
        dx, dy, power, bend = _response(centres, conics, bends, splat, column + 0.5, row + 0.5)
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
        by_power = -by_alpha * alpha / bend
        by_scale = -by_power * power
        by_conic[splat, 0] += 0.5 * by_power * dx * dx
        by_conic[splat, 1] += by_power * dx * dy
        by_conic[splat, 2] += 0.5 * by_power * dy * dy
        by_bend[splat, 0] += 2 * by_scale * dx
        by_bend[splat, 1] += 2 * by_scale * dy
        by_bend[splat, 2] += by_scale * dx * dx
        by_bend[splat, 3] += 2 * by_scale * dx * dy
        by_bend[splat, 4] += by_scale * dy * dy
        a, b, c = conics[splat]
        f, g, p, q, r = bends[splat]
        by_centre[splat, 0] -= by_power * (a * dx + b * dy) + 2 * by_scale * (f + p * dx + q * dy)
        by_centre[splat, 1] -= by_power * (b * dx + c * dy) + 2 * by_scale * (g + q * dx + r * dy)
  return by_centre, by_conic, by_bend, by_opacity, by_color


def composite_backward(
  gaussians: tuple[np.ndarray, ...], drawn: Drawn, slope: np.ndarray
) -> tuple[np.ndarray, ...]:
  """Returns the derivatives of a loss by the splats' values, as `projection.Projected` has them.

  Args:
    gaussians: As given to `composite`.
    drawn: What it returned.
    slope: Derivative of the loss by the picture [H, W, 3].
  """
  inputs = (*gaussians, *drawn[1:], slope)
  found: tuple[np.ndarray, ...] = _backward(*inputs)  # type: ignore[call-arg]
  return found
