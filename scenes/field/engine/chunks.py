"""The trainer's step for CPU threads: chunks of samples that stay in a thread's cache.

A worker (a thread) fills chunks of a few hundred samples: march, encode, base network, drop what
lies behind matter, view network, composite, losses, and all of it backwards.
"""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import functools
from typing import Any, NamedTuple

import warp as wp

from nerf2real.scenes.field.engine.device import WIDE_OPTIONS
from nerf2real.scenes.field.engine.functions import Functions
from nerf2real.scenes.field.engine.layout import (
  CHUNK_SAMPLES,
  AdamW,
  Floats,
  Model,
  Occupancy,
  Optimised,
  Pictures,
  Settings,
  Workers,
)
from nerf2real.scenes.field.engine.losses import squareplus
from nerf2real.scenes.field.engine.native.vectors import PADDING
from nerf2real.scenes.field.engine.rays import draw_ray, largest, squash

_MARCH = 1 << 24  # a ray's number: its place in the step's order, and this for every march before
_LIMIT_RATIO = 4.0  # of the depth limits of a ray's marches


class Chunks(NamedTuple):
  """Kernels of one shape of field."""

  train: Any  # a thread's whole share of a step
  scatter: Any  # a level's part of the table's gradient
  adam: Any
  densities: Any


@functools.cache
def build(f: Functions) -> Chunks:
  """Defines the kernels; Warp compiles them at their first launch."""
  rows, stride, ray_columns = f.shape.rows, f.stride, f.ray_columns
  parameters = f.shape.parameters
  at_place, at_out = stride * rows.PLACE_U, stride * rows.OUT
  at_extent = stride * (rows.INPUT + 2 * f.shape.levels)
  look, ray_losses, draw_empty, empty_loss, clear = f.losses

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def train(
    p: Pictures,
    s: Settings,
    grids: Occupancy,
    m: Model,
    workers: Workers,
    seed: wp.uint64,
    first_worker: int,
    budget: int,
    threshold: float,
  ):
    """Adds the gradient of as many random rays as fit into a budget of samples.

    A ray that the depth limit ended before opaque matter is marched again: every ray that is drawn
    counts once, whatever the grid holds.
    Writes figures [6]: rays, kept samples, marched samples, sums over the rays of squared error,
    Charbonnier loss and distortion loss.
    """
    number = first_worker + wp.tid()
    w = workers[number]
    first_ray = wp.int64(number) << wp.int64(32)
    rays_done = wp.int32(0)
    drawn = wp.int32(0)
    waiting = wp.int32(0)  # rays to march again
    total = wp.int32(0)
    marched = wp.int32(0)
    sums = wp.vec3d()
    for i in range(parameters):
      w.gradient[i] = 0.0
    while marched < budget or waiting > 0:
      rays = wp.int32(0)
      count = wp.int32(0)
      while (
        rays < ray_columns
        and count + s.ray_samples <= CHUNK_SAMPLES
        and (waiting > 0 or marched < budget)
      ):
        number = drawn
        if waiting > 0:
          waiting -= 1
          number = w.again[waiting] + _MARCH
        else:
          drawn += 1
        index = first_ray + wp.int64(number % _MARCH)
        limit = s.depth_limit * wp.pow(_LIMIT_RATIO, wp.float32(number // _MARCH))
        draw_ray(p, s, seed, index, w.rays, ray_columns, rays)
        w.first[rays] = count
        found, cut = f.march_ray(grids, s, w, seed, index, rays, limit, count)
        w.number[rays] = wp.where(cut, ~number, number)
        for n in range(count, count + found):
          w.ray_of[n] = rays
        count += found
        rays += 1
      w.first[rays] = count
      marched += wp.max(count, 1)
      f.place(w, s, 0, count)
      f.encode(w, m, 0, count)
      f.base_forward(w, m, 0, count)
      f.opacity(w, s, 0, count)
      count = f.keep_visible(w, rays, waiting, threshold)
      f.view_forward(w, m, s, 0, count)
      for r in range(rays):
        w.last[r] = w.first[r + 1]
        look(w, r)
      for r in range(rays, wp.min(rays + 2, ray_columns)):
        w.rays[14 * ray_columns + r] = 0.0  # of the chunk before
      for r in range(rays):
        if w.number[r] < 0 and w.last[r] == w.first[r]:
          waiting += 1
        else:
          rays_done += 1
          losses = ray_losses(w, s, r)
          sums += wp.vec3d(wp.float64(losses[0]), wp.float64(losses[1]), wp.float64(losses[2]))
      clear(w.work, count, count + PADDING)
      f.view_backward(w, m, 0, count)
      f.base_backward(w, m, 0, count, total)
      f.network_gradient(w, 0, count, 1, 0, 1)
      total += count
    if p.empty.shape[0] > 0:
      weight = s.empty_weight * wp.float32(rays_done) / wp.float32(wp.max(s.empty_samples, 1))
      for begin in range(0, s.empty_samples, CHUNK_SAMPLES):
        count = wp.min(s.empty_samples - begin, CHUNK_SAMPLES)
        for n in range(count):
          draw_empty(p, s, w.work, seed, first_ray + wp.int64(begin + n), n)
        f.encode(w, m, 0, count)
        f.base_forward(w, m, 0, count)
        for n in range(count):
          empty_loss(s, w.work, weight, n)
        clear(w.work, count, count + PADDING)
        f.base_backward(w, m, 0, count, total)
        f.network_gradient(w, 0, count, 0, 0, 1)
        total += count
    w.figures[0] = wp.float64(rays_done)
    w.figures[1] = wp.float64(total)
    w.figures[2] = wp.float64(marched)
    for i in range(3):
      w.figures[3 + i] = sums[i]

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def densities(
    s: Settings,
    m: Model,
    workers: Workers,
    number: int,
    size: int,
    threads: int,
    positions: wp.array(dtype=wp.vec3),
    extent: float,
    first: int,
    stop: int,
    result: Floats,
  ):
    """Writes the densities [1/unit] at points [first, stop) of the unit frame.

    A thread does `size` points at a time, in columns of its own.
    """
    w = workers[number]
    column = wp.tid() * size
    at = first + column
    while at < stop:
      count = wp.min(size, stop - at)
      for n in range(count):
        q = squash(positions[at + n], wp.max(1.0, largest(positions[at + n])))
        for a in range(3):
          w.work[at_place + a * stride + column + n] = q[a]
          w.work[at_extent + a * stride + column + n] = extent
      f.encode(w, m, column, column + count)
      f.base_forward(w, m, column, column + count)
      for n in range(count):
        z = s.density_gain * w.work[at_out + column + n] + s.density_bias
        result[at + n] = s.density_scale * squareplus(z)
      at += size * threads

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def scatter(gradient: Floats, workers: Workers, m: Model, level: int):
    """Adds the table's gradient of one level, all workers' samples in one order."""
    for number in range(workers.shape[0]):
      w = workers[number]
      count = wp.int32(w.figures[1])
      f.scatter_points(gradient, w, m, 0, count, level)

  @wp.kernel(module="unique", enable_backward=False, module_options=WIDE_OPTIONS)
  def adam(v: Optimised, how: AdamW, start: int, stop: int, size: int):
    """Updates [start, stop) by AdamW where the gradient is not zero, then clears the gradient.

    A thread does `size` parameters. Those that no sample touched keep their value and their
    moments, as in instant-ngp.
    """
    begin = start + wp.tid() * size
    f.adam_range(v, how, begin, wp.min(begin + size, stop))

  return Chunks(train, scatter, adam, densities)
