"""Losses of a training ray and of points known to be empty, with their gradients, in Warp."""
# mypy: ignore-errors
# Kernels are Python only in their syntax: their annotations are Warp's.

import math
from typing import Any, NamedTuple

import warp as wp

from nerf2real.scenes.field.engine.layout import Floats, Pictures, Settings, Shape, Worker
from nerf2real.scenes.field.engine.native import grid as native_grid
from nerf2real.scenes.field.engine.native import vectors as native
from nerf2real.scenes.field.engine.rays import squash, uniform

_EMPTY_SLOPE = 0.1 * math.log2(10.0)  # of a variance input by the deviation's decimal logarithm


class Losses(NamedTuple):
  """Functions of one shape of field."""

  look: Any
  ray_losses: Any
  draw_empty: Any
  empty_loss: Any
  clear: Any


@wp.func_native(native.snippet(native_grid.SQUAREPLUS, lanes=1))
def squareplus(z: float) -> wp.float32: ...


@wp.func
def squareplus_slope(z: float) -> wp.float32:
  """Derivative of squareplus."""
  root = wp.sqrt(z * z + 4.0)
  return wp.where(z > 0.0, 0.5 * (1.0 + z / root), 2.0 / (root * (root - z)))


@wp.func
def spacing(t: float) -> wp.float32:
  """Normalised distance of the distortion loss, see sampling.spacing."""
  return wp.where(t < 1.0, 0.5 * t, 1.0 - 0.5 / t)


def build(shape: Shape, stride: int, ray_columns: int) -> Losses:
  """Defines the functions, see `functions.build`."""
  rows, outputs = shape.rows, shape.outputs
  at_distance, at_length = stride * rows.DISTANCE, stride * rows.LENGTH
  at_weight, at_through, at_d_weight = (
    stride * row for row in (rows.WEIGHT, rows.THROUGH, rows.D_WEIGHT)
  )
  at_out, at_color = stride * rows.OUT, stride * rows.COLOR
  at_d_color, at_d_out = stride * rows.D_COLOR, stride * rows.D_OUT
  at_place = stride * rows.PLACE_U
  at_extent = stride * (rows.INPUT + 2 * shape.levels)
  at_specular = at_color + 3 * stride

  @wp.func
  def look(w: Worker, r: int):
    """Writes 1 / z of where a ray ends, in the mean over its samples; 0 where it has none."""
    inverse = wp.float32(0.0)
    for n in range(w.first[r], w.last[r]):
      inverse += w.work[at_weight + n] / w.work[at_distance + n]
    w.rays[17 * ray_columns + r] = inverse * w.rays[16 * ray_columns + r]

  @wp.func
  def bend_slope(w: Worker, s: Settings, r: int) -> wp.float32:
    """Returns the derivative of the loss on planes by the 1 / z of a ray of three.

    Along a line of a picture 1 / z of a plane is linear. The loss is that of Geman and McClure of
    the second difference relative to the middle: an edge counts for little, however sharp it is.
    The less the more the three colours differ: there the picture itself tells the surface.
    """
    slot = wp.int32(w.rays[14 * ray_columns + r])
    lead = r - slot + 1
    if slot == 0 or lead < 0 or lead + 2 >= ray_columns:
      return 0.0
    whole = wp.bool(True)
    contrast = wp.float32(0.0)
    for k in range(3):
      ray = lead + k
      whole = whole and wp.int32(w.rays[14 * ray_columns + ray]) == k + 1
      whole = whole and w.rays[15 * ray_columns + ray] == w.rays[15 * ray_columns + r]
      whole = whole and w.rays[17 * ray_columns + ray] > 0.0
      for c in range(3):
        channel = (6 + c) * ray_columns
        contrast = wp.max(contrast, wp.abs(w.rays[channel + ray] - w.rays[channel + lead + 1]))
    if not whole:
      return 0.0
    ends = 17 * ray_columns + lead
    middle = wp.max(w.rays[ends + 1], 1e-3)
    bend = (w.rays[ends] - 2.0 * w.rays[ends + 1] + w.rays[ends + 2]) / middle
    scale = s.planar_bend * s.planar_bend
    weight = s.planar_weight * wp.exp(-contrast / s.planar_contrast)
    slope = weight * 2.0 * bend * scale / ((bend * bend + scale) * (bend * bend + scale)) / middle
    return wp.where(slot == 2, -2.0 * slope, slope)

  @wp.func
  def ray_losses(w: Worker, s: Settings, r: int) -> wp.vec3:
    """Composites a ray, adds its losses' gradients; returns squared error and both losses.

    Gradients: dC/dsigma_i = length_i (T_{i+1} c_i - sum_{j>i} w_j c_j), and likewise for the
    distortion loss, whose derivative by w_i is 2 sum_j w_j |m_i - m_j| + 2/3 w_i l_i in O(n).

    Gradients at a sample are scaled by min(1, (t / near)^2): the nearer a place is, the more pixels
    look at it, and their many gradients build floaters before the cameras. Source: Philip and
    Deschaintre 2023, "Floaters no more: radiance field gradient scaling".
    """
    work = w.work
    start, stop = w.first[r], w.last[r]
    color = wp.vec3()
    total = wp.float32(0.0)
    moment = wp.float32(0.0)
    for n in range(start, stop):
      weight = work[at_weight + n]
      for c in range(3):
        color[c] += weight * (work[at_color + c * stride + n] + work[at_specular + c * stride + n])
      total += weight
      moment += weight * spacing(work[at_distance + n])
    rest = 1.0 - total
    pad = s.charbonnier * s.charbonnier
    slope = wp.vec3()
    square = wp.float32(0.0)
    photometric = wp.float32(0.0)
    behind = wp.float32(0.0)
    for c in range(3):
      background = w.rays[(10 + c) * ray_columns + r]
      error = color[c] + rest * background - w.rays[(6 + c) * ray_columns + r]
      padded = wp.sqrt(error * error + pad)
      slope[c] = error / padded / 3.0
      square += error * error / 3.0
      photometric += padded / 3.0
      behind += slope[c] * background
    anchor = w.rays[13 * ray_columns + r]
    anchored = wp.where(anchor > 0.0, s.anchor_weight, 0.0)
    goal = spacing(anchor)
    nearer = bend_slope(w, s, r) * w.rays[16 * ray_columns + r]
    below = wp.float32(0.0)
    moment_below = wp.float32(0.0)
    distortion = wp.float32(0.0)
    for n in range(start, stop):
      weight = work[at_weight + n]
      t = work[at_distance + n]
      half = 0.5 * work[at_length + n]
      m = spacing(t)
      extent = spacing(t + half) - spacing(t - half)
      above = total - below - weight
      moment_above = moment - moment_below - weight * m
      spread = m * (below - above) - moment_below + moment_above
      distortion += weight * spread + weight * weight * extent / 3.0
      d_weight = (
        s.distortion * 2.0 * (spread + weight * extent / 3.0)
        + anchored * (wp.abs(m - goal) - (1.0 - goal))
        + nearer / t
        - behind
      )
      share = wp.min(1.0, t * t * s.near_scale)
      for c in range(3):
        d_weight += slope[c] * (
          work[at_color + c * stride + n] + work[at_specular + c * stride + n]
        )
        work[at_d_color + c * stride + n] = slope[c] * weight * share
      work[at_d_weight + n] = d_weight
      below += weight
      moment_below += weight * m
    later = wp.float32(0.0)
    for back in range(stop - start):
      n = stop - 1 - back
      d_weight = work[at_d_weight + n]
      d_density = work[at_length + n] * (work[at_through + n] * d_weight - later)
      later += work[at_weight + n] * d_weight
      z = s.density_gain * work[at_out + n] + s.density_bias
      slope_of_density = s.density_gain * s.density_scale * squareplus_slope(z)
      t = work[at_distance + n]
      work[at_d_out + n] = d_density * slope_of_density * wp.min(1.0, t * t * s.near_scale)
    return wp.vec3(square, photometric, distortion)

  @wp.func
  def draw_empty(p: Pictures, s: Settings, work: Floats, seed: wp.uint64, index: wp.int64, n: int):
    """Draws a point in a cell known to be empty as sample n."""
    size = s.empty_size
    scale = 2.0 / wp.float32(size)
    found = wp.int32(uniform(seed, index, 16) * wp.float32(p.empty.shape[0]))
    cell = p.empty[wp.min(found, p.empty.shape[0] - 1)]
    q = wp.vec3(
      (wp.float32(cell // (size * size)) + uniform(seed, index, 17)) * scale - 1.0,
      (wp.float32(cell // size % size) + uniform(seed, index, 18)) * scale - 1.0,
      (wp.float32(cell % size) + uniform(seed, index, 19)) * scale - 1.0,
    )
    q = squash(q, 1.0)
    # Standard deviations from a thousandth to a tenth of the unit, alike on a logarithmic scale.
    extent = 1.0 + _EMPTY_SLOPE * (2.0 * uniform(seed, index, 20) - 3.0)
    for a in range(3):
      work[at_place + a * stride + n] = q[a]
      work[at_extent + a * stride + n] = extent

  @wp.func
  def empty_loss(s: Settings, work: Floats, weight: float, n: int):
    """Writes D_OUT of sample n for the loss weight * log(1 + density)."""
    z = s.density_gain * work[at_out + n] + s.density_bias
    density = s.density_scale * squareplus(z)
    for i in range(1, outputs):
      work[at_d_out + i * stride + n] = 0.0
    work[at_d_out + n] = (
      weight * s.density_gain * s.density_scale * squareplus_slope(z) / (1.0 + density)
    )

  @wp.func
  def clear(work: Floats, begin: int, end: int):
    """Lets samples have no gradient."""
    for n in range(begin, end):
      for i in range(3):
        work[at_d_color + i * stride + n] = 0.0
      for i in range(outputs):
        work[at_d_out + i * stride + n] = 0.0

  return Losses(look, ray_losses, draw_empty, empty_loss, clear)
