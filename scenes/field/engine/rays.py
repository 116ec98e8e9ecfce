"""Rays in Warp: random numbers, pixels, marching through two occupancy grids.

The inner grid covers the unit cube; the outer one the whole squashed space of `contraction`. Inside
the cube samples are `step` apart, outside `OUTER_STEP * step * |x|_max`.
"""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import warp as wp

from nerf2real.scenes.field.engine.layout import Floats, Occupancy, Pictures, Settings
from nerf2real.scenes.field.engine.native import grid as native_grid
from nerf2real.scenes.field.engine.native import vectors as native

FAR = 16.0  # chosen: rays end here [unit]; squashed to 1.94 of 2
NO_LIMIT = 1e9  # an optical depth that no ray reaches
OUTER_STEP = 2.0  # chosen: outside, intervals are this many steps times |x|_max


@wp.func_native(native_grid.UNIFORM)
def uniform(seed: wp.uint64, index: wp.int64, dimension: int) -> wp.float32: ...


@wp.func
def look_up(p: Pictures, level: int, image: int, px: int, py: int) -> wp.vec3:
  """Bilinear colour in [0, 1] at the centre of full-size pixel (px, py)."""
  height, width = p.heights[level], p.widths[level]
  start = p.starts[level] + image * height * width * 3
  inverse = 1.0 / p.factors[level]
  fx = wp.max((wp.float32(px) + 0.5) * inverse - 0.5, 0.0)
  fy = wp.max((wp.float32(py) + 0.5) * inverse - 0.5, 0.0)
  x0 = wp.min(wp.int32(fx), width - 1)
  y0 = wp.min(wp.int32(fy), height - 1)
  x1 = wp.min(x0 + 1, width - 1)
  y1 = wp.min(y0 + 1, height - 1)
  fx -= wp.float32(x0)
  fy -= wp.float32(y0)
  result = wp.vec3()
  for c in range(3):
    upper = wp.float32(p.pixels[start + (y0 * width + x0) * 3 + c]) * (1.0 - fx)
    upper += wp.float32(p.pixels[start + (y0 * width + x1) * 3 + c]) * fx
    lower = wp.float32(p.pixels[start + (y1 * width + x0) * 3 + c]) * (1.0 - fx)
    lower += wp.float32(p.pixels[start + (y1 * width + x1) * 3 + c]) * fx
    result[c] = (upper * (1.0 - fy) + lower * fy) * wp.static(1.0 / 255.0)
  return result


@wp.func
def middle_of_three(chance: float, size: int, apart: int) -> int:
  """Returns a pixel in [apart, size - apart), so that both others lie in the picture."""
  room = size - 2 * apart
  return apart + wp.min(wp.int32(chance * wp.float32(room)), room - 1)


@wp.func
def draw_ray(
  p: Pictures, s: Settings, seed: wp.uint64, index: wp.int64, rays: Floats, size: int, r: int
):
  """Draws a pixel and a blur, or an anchor; writes column r of Worker.rays.

  Of some threes of successive numbers the pixels lie in a row or a column, equally far apart.
  """
  images = p.origins.shape[0]
  height, width = p.heights[0], p.widths[0]
  image = wp.min(wp.int32(uniform(seed, index, 0) * wp.float32(images)), images - 1)
  px = wp.min(wp.int32(uniform(seed, index, 1) * wp.float32(width)), width - 1)
  py = wp.min(wp.int32(uniform(seed, index, 2) * wp.float32(height)), height - 1)
  goal = wp.float32(0.0)
  blur = wp.float32(0.0)
  slot = wp.float32(0.0)
  place = wp.int32(index % wp.int64(3))
  leader = index - wp.int64(place)
  count = p.anchors.shape[0]
  if s.planar_fraction > 0.0 and uniform(seed, leader, 21) < s.planar_fraction:
    slot = wp.float32(place + 1)
    apart = 2 + wp.int32(uniform(seed, leader, 22) * wp.float32(s.planar_reach - 2))
    image = wp.min(wp.int32(uniform(seed, leader, 0) * wp.float32(images)), images - 1)
    is_row = uniform(seed, leader, 23) < 0.5
    dx = wp.where(is_row, wp.min(apart, (width - 1) // 2), 0)
    dy = wp.where(is_row, 0, wp.min(apart, (height - 1) // 2))
    px = middle_of_three(uniform(seed, leader, 1), width, dx) + (place - 1) * dx
    py = middle_of_three(uniform(seed, leader, 2), height, dy) + (place - 1) * dy
  elif count > 0 and uniform(seed, index, 9) < s.anchor_fraction:
    anchor = p.anchors[wp.min(wp.int32(uniform(seed, index, 10) * wp.float32(count)), count - 1)]
    image = wp.int32(anchor[0])
    px = wp.int32(anchor[1])
    py = wp.int32(anchor[2])
    goal = anchor[3]
  elif s.blur_max > 0.0 and uniform(seed, index, 3) >= s.blur_sharp:
    blur = s.blur_max * wp.pow(uniform(seed, index, 4), s.blur_power)
  direction = p.rotations[image] * wp.normalize(p.directions[py * width + px])
  origin = p.origins[image]
  level = wp.int32(0)
  while level + 1 < p.blurs.shape[0] and p.blurs[level + 1] <= blur:
    level += 1
  color = look_up(p, level, image, px, py)
  if level + 1 < p.blurs.shape[0]:
    low = p.blurs[level] * p.blurs[level]
    high = p.blurs[level + 1] * p.blurs[level + 1]
    mix = (blur * blur - low) / (high - low)
    if mix > 0.0:
      color += mix * (look_up(p, level + 1, image, px, py) - color)
  for c in range(3):
    rays[c * size + r] = origin[c]
    rays[(3 + c) * size + r] = direction[c]
    rays[(6 + c) * size + r] = color[c]
    background = wp.float32(0.0)
    if s.random_background > 0:
      background = uniform(seed, index, 6 + c)
    rays[(10 + c) * size + r] = background
  rays[9 * size + r] = 1.0 + 12.0 * blur * blur
  rays[13 * size + r] = goal
  rays[14 * size + r] = slot
  rays[15 * size + r] = wp.float32((leader / wp.int64(3)) % wp.int64(1 << 22))
  rays[16 * size + r] = wp.length(p.directions[py * width + px])


@wp.func
def largest(p: wp.vec3) -> wp.float32:
  """Maximum norm."""
  return wp.max(wp.max(wp.abs(p[0]), wp.abs(p[1])), wp.abs(p[2]))


@wp.func_native(native.snippet(native_grid.SQUASH, lanes=1))
def squash(p: wp.vec3, norm: float) -> wp.vec3:
  """Grid coordinates in [0, 1]^3 of a point whose max(1, |x|_max) is `norm`."""
  ...


@wp.func
def march(
  grids: Occupancy,
  s: Settings,
  origin: wp.vec3,
  direction: wp.vec3,
  jitter: float,
  limit: float,
  work: Floats,
  stride: int,
  at: int,
):
  """Writes the middles and lengths (rows 0 and 1) of a ray's intervals in occupied cells.

  Nothing is written where `at` is negative. The march ends where the grid's optical depth passes
  `limit`. A cell's density is the largest that was seen in it, so that the ray may have met less.

  Returns:
    The number of intervals, and whether the limit ended the march.
  """
  count = wp.int32(0)
  step = s.step
  t = s.near + jitter * step
  size = grids.inner_size
  half_size = wp.float32(size) * 0.5
  outer_size = grids.outer_size
  outer_scale = wp.float32(outer_size)
  outer_cell = 2.0 / outer_scale
  depth = wp.float32(0.0)
  stride_per_cell = 1.0 / half_size / (largest(direction) * step)
  while t < FAR and count < s.ray_samples and depth <= limit:
    middle = t + 0.5 * step
    p = origin + middle * direction
    norm = largest(p)
    if norm < 1.0:
      q = (p + wp.vec3(1.0, 1.0, 1.0)) * half_size
      x = wp.min(wp.int32(q[0]), size - 1)  # the largest number below 1 is rounded to 2
      y = wp.min(wp.int32(q[1]), size - 1)
      z = wp.min(wp.int32(q[2]), size - 1)
      index = (x * size + y) * size + z
      away = wp.int32(grids.inner_distance[index])
      if away == 0:
        if at >= 0:
          work[at + count] = middle
          work[stride + at + count] = step
        count += 1
        depth += grids.inner_density[index] * step
        t += step
      else:
        whole = wp.int32(wp.float32(away - 1) * stride_per_cell)
        t += step * wp.float32(wp.max(whole, 1))
    else:
      length = OUTER_STEP * step * norm
      middle = t + 0.5 * length
      p = origin + middle * direction
      norm = wp.max(1.0, largest(p))
      q = squash(p, norm) * outer_scale
      index = (wp.int32(q[0]) * outer_size + wp.int32(q[1])) * outer_size + wp.int32(q[2])
      away = wp.int32(grids.outer_distance[index])
      if away == 0:
        if at >= 0:
          work[at + count] = middle
          work[stride + at + count] = length
        count += 1
        depth += grids.outer_density[index] * length
        t += length
      else:
        # Squashing shrinks lengths by norm / 2 at least.
        t += wp.max(wp.float32(away - 1) * outer_cell * norm, length)
  return count, depth > limit
