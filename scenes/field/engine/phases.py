"""The trainer's step in phases, for a GPU: a thread does a ray or `size` samples, one on CUDA.

Samples [0, spare) of the one worker are the points known to be empty; `used` counts samples, those
included.
"""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import functools
from typing import Any, NamedTuple

import warp as wp

from nerf2real.scenes.field.engine.device import WIDE_OPTIONS
from nerf2real.scenes.field.engine.functions import Functions
from nerf2real.scenes.field.engine.layout import (
  Floats,
  Ints,
  Model,
  Occupancy,
  Pictures,
  Settings,
  Worker,
  Workers,
)
from nerf2real.scenes.field.engine.native.vectors import PADDING
from nerf2real.scenes.field.engine.rays import NO_LIMIT, draw_ray


class Phases(NamedTuple):
  """Kernels of one shape of field, in their order."""

  draw: Any
  forward: Any  # twice: of all rays' samples, and of those that were marched again
  march_again: Any
  see: Any
  color: Any
  compare: Any
  backward: Any
  sum_products: Any
  scatter: Any


@functools.cache
def build(f: Functions) -> Phases:
  """Defines the kernels; Warp compiles them at their first launch."""
  rows, stride, ray_columns = f.shape.rows, f.stride, f.ray_columns
  at_alpha, at_weight, at_through = (
    stride * row for row in (rows.ALPHA, rows.WEIGHT, rows.THROUGH)
  )
  look, ray_losses, draw_empty, empty_loss, clear = f.losses

  @wp.func
  def is_visible(w: Worker, n: int, total: int) -> wp.bool:
    """Whether a ray has sample n and sees it."""
    if n >= total:
      return False
    return n >= w.first[w.ray_of[n]] and n < w.last[w.ray_of[n]]

  @wp.func
  def place_ray(
    grids: Occupancy, s: Settings, w: Worker, seed: wp.uint64, r: int, limit: float, used: Ints
  ) -> wp.bool:
    """Finds room for a ray's samples, none where there is too little; whether the limit cut it."""
    found, cut = f.march_ray(grids, s, w, seed, wp.int64(r), r, limit, -1)
    at = wp.atomic_add(used, 0, found)
    if at + found > stride - PADDING:
      found = 0
    else:
      f.march_ray(grids, s, w, seed, wp.int64(r), r, limit, at)
    w.first[r] = at
    w.last[r] = at + found
    for n in range(at, at + found):
      w.ray_of[n] = r
    wp.atomic_add(w.figures, 2, wp.float64(found))
    return cut

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def draw(
    p: Pictures, s: Settings, grids: Occupancy, workers: Workers, seed: wp.uint64, used: Ints
  ):
    """Draws a ray and marches it up to the depth limit."""
    r = wp.tid()
    w = workers[0]
    draw_ray(p, s, seed, wp.int64(r), w.rays, ray_columns, r)
    w.number[r] = wp.where(place_ray(grids, s, w, seed, r, s.depth_limit, used), -1, 0)
    wp.atomic_add(w.figures, 0, wp.float64(1.0))

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def forward(
    p: Pictures,
    s: Settings,
    m: Model,
    workers: Workers,
    seed: wp.uint64,
    used: Ints,
    first: Ints,
    spare: int,
    size: int,
    weight: float,
  ):
    """Base network at samples from `first` on, and the gradient at points known to be empty."""
    begin = first[0] // size * size + wp.tid() * size
    end = begin + size
    w = workers[0]
    if begin < wp.min(used[0], stride - PADDING):
      if begin < spare:
        for n in range(begin, end):
          draw_empty(p, s, w.work, seed, wp.int64(n), n)
      else:
        f.place(w, s, begin, end)
      f.encode(w, m, begin, end)
      f.base_forward(w, m, begin, end)
      if begin < spare:
        for n in range(begin, end):
          empty_loss(s, w.work, wp.where(n < s.empty_samples, weight, 0.0), n)
      else:
        f.opacity(w, s, begin, end)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def march_again(
    s: Settings, grids: Occupancy, workers: Workers, seed: wp.uint64, threshold: float, used: Ints
  ):
    """Marches a ray to its end that the depth limit cut before opaque matter."""
    r = wp.tid()
    w = workers[0]
    if w.number[r] < 0:
      through = wp.float32(1.0)
      for n in range(w.first[r], w.last[r]):
        through *= 1.0 - w.work[at_alpha + n]
      if through >= threshold:
        place_ray(grids, s, w, seed, r, NO_LIMIT, used)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def see(workers: Workers, threshold: float):
    """Weights of a ray's samples, up to the last one that is visible."""
    r = wp.tid()
    w = workers[0]
    through = wp.float32(1.0)
    n = w.first[r]
    while n < w.last[r] and through >= threshold:
      alpha = w.work[at_alpha + n]
      w.work[at_weight + n] = through * alpha
      through *= 1.0 - alpha
      w.work[at_through + n] = through
      n += 1
    w.last[r] = n
    look(w, r)
    wp.atomic_add(w.figures, 1, wp.float64(n - w.first[r]))

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def color(s: Settings, m: Model, workers: Workers, used: Ints, first: int, size: int):
    """Colours of the samples."""
    begin = first + wp.tid() * size
    w = workers[0]
    if begin < wp.min(used[0], stride - PADDING):
      f.view_forward(w, m, s, begin, begin + size)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def compare(s: Settings, workers: Workers):
    """Losses of a ray and their gradient at its samples."""
    w = workers[0]
    losses = ray_losses(w, s, wp.tid())
    for i in range(3):
      wp.atomic_add(w.figures, 3 + i, wp.float64(losses[i]))

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def backward(m: Model, workers: Workers, used: Ints, first: int, spare: int, size: int):
    """The networks backwards; `kept` gets every sample, those that nobody sees with zeros."""
    begin = first + wp.tid() * size
    end = begin + size
    w = workers[0]
    total = wp.min(used[0], stride - PADDING)
    if begin < total:
      if begin >= spare:
        for n in range(begin, end):
          if not is_visible(w, n, total):
            clear(w.work, n, n + 1)
        f.view_backward(w, m, begin, end)
      f.base_backward(w, m, begin, end, 0)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def sum_products(workers: Workers, used: Ints, first: int, size: int, parts: int):
    """The networks' gradient: a thread does a part of the matrices and `size` samples."""
    part, stretch = wp.tid()
    begin = first + stretch * size
    w = workers[0]
    total = wp.min(used[0], stride - PADDING)
    if begin < total:
      end = wp.min(begin + size, total)
      f.network_gradient(w, begin, end, 1, part, parts)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def scatter(gradient: Floats, workers: Workers, m: Model, used: Ints, first: int, size: int):
    """The table's gradient: a thread does a level and `size` samples."""
    level, stretch = wp.tid()
    begin = first + stretch * size
    w = workers[0]
    total = wp.min(used[0], stride - PADDING)
    if begin < total:
      f.scatter_points(gradient, w, m, begin, wp.min(begin + size, total), level)

  return Phases(draw, forward, march_again, see, color, compare, backward, sum_products, scatter)
