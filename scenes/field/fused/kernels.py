"""The fused training and rendering kernels: rays in, gradients or colours out, in numba.

A thread works through chunks of a few hundred samples that stay in its cache: march, encode, base
network, drop what lies behind matter, view network, composite, losses, and all of it backwards.
Flat float32 arrays. Shapes: N samples of a chunk, R rays of a chunk, S samples of a step.
"""

from typing import NamedTuple

import numba
import numpy as np

from nerf2real.scenes.field.fused.cache import KERNEL_CACHE
from nerf2real.scenes.field.fused.fast_math import fast_exp, fast_log2
from nerf2real.scenes.field.fused.grid import encode
from nerf2real.scenes.field.fused.march import march, squash, uniform
from nerf2real.scenes.field.fused.network import (
  base_backward,
  base_forward,
  view_backward,
  view_forward,
  view_offsets,
)

_ZERO, _ONE, _HALF, _TWO, _FOUR = (np.float32(x) for x in (0, 1, 0.5, 2, 4))
_TWELFTH = np.float32(1 / 12)
_THIRD = np.float32(1 / 3)
_VARIANCE_FLOOR = np.float32(1e-10)  # as in encoding.variance_features
_LOG_SCALE = np.float32(0.05)
CHUNK_RAYS = 128  # ours: rays of a chunk at most


class Pictures(NamedTuple):
  """Training pictures as the kernel reads them, see views.BlurPyramid."""

  pixels: np.ndarray  # uint8, flat: every level [N, h, w, 3] behind the other
  starts: np.ndarray  # int64 [K]: where a level starts in `pixels`
  heights: np.ndarray  # int64 [K]
  widths: np.ndarray  # int64 [K]
  factors: np.ndarray  # float32 [K]: how much smaller a level's pictures are
  blurs: np.ndarray  # float32 [K]: standard deviation [pixel of the full size]
  directions: np.ndarray  # float32 [H * W * 3]: camera rays, z = 1
  rotations: np.ndarray  # float32 [N * 9]: unit frame from camera
  origins: np.ndarray  # float32 [N * 3]
  anchors: np.ndarray  # float32 [A * 4]: picture, pixel x and y, distance along the ray [unit]
  empty: np.ndarray  # int64 [E]: cells of the unit cube known to be empty


class Settings(NamedTuple):
  """Numbers that the kernel needs."""

  density_gain: np.float32
  density_bias: np.float32
  density_scale: np.float32
  specular_bias: np.float32
  paper_footprint: bool  # footprint 1 + blur instead of 1 + 12 blur^2
  pixel_angle: np.float32
  step: np.float32
  variance_step: np.float32  # interval that the variance tells of, inside the unit cube
  near: np.float32
  depth_limit: np.float32  # a ray's march ends where the grid's optical depth passes this
  ray_samples: int  # most samples of a ray
  charbonnier: np.float32
  distortion: np.float32
  blur_max: np.float32
  blur_sharp: np.float32  # fraction of the rays that are not blurred
  blur_power: np.float32  # blur = blur_max * uniform^power
  random_background: bool
  anchor_fraction: np.float32  # fraction of the rays that end at a known point
  anchor_weight: np.float32
  empty_samples: int  # points a call in cells known to be empty
  empty_weight: np.float32
  empty_size: int  # such cells along an axis of the unit cube


class Chunk(NamedTuple):
  """A thread's work arrays. The last two keep a whole step's samples."""

  distance: np.ndarray  # [N]
  length: np.ndarray  # [N]
  ray_of: np.ndarray  # int64 [N]
  x: np.ndarray  # [N, I]
  pre: np.ndarray  # [N, W]
  hidden: np.ndarray  # [N, W]
  inverse_std: np.ndarray  # [N]
  out: np.ndarray  # [N, O]
  alpha: np.ndarray  # [N]
  view_pre: np.ndarray  # [N, V]
  view_hidden: np.ndarray  # [N, V]
  color: np.ndarray  # [N, 6]
  d_color: np.ndarray  # [N, 3]
  d_out: np.ndarray  # [N, O]
  d_hidden: np.ndarray  # [N, W]
  d_view: np.ndarray  # [N, V]
  weight: np.ndarray  # [N]
  through: np.ndarray  # [N]: transmittance behind the sample
  d_weight: np.ndarray  # [N]
  first: np.ndarray  # int64 [R + 1]: a ray's first sample
  rays: np.ndarray  # [R, 14]: origin, direction, target, footprint, background, anchor or 0
  harmonics: np.ndarray  # [R, 9]
  offsets: np.ndarray  # [R, V]
  d_rays: np.ndarray  # [R, V]
  coordinates: np.ndarray  # [S, 3]
  d_features: np.ndarray  # [S, 2 L]


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def _look_up(pictures, level, image, px, py, c):
  """Bilinear value in [0, 1] of a channel at the centre of full-size pixel (px, py)."""
  height, width = pictures.heights[level], pictures.widths[level]
  start = pictures.starts[level] + image * height * width * 3
  pixels = pictures.pixels
  scale = np.float32(1 / 255)
  if pictures.factors[level] == _ONE:
    return np.float32(pixels[start + (py * width + px) * 3 + c]) * scale
  inverse = _ONE / pictures.factors[level]
  fx = max((np.float32(px) + _HALF) * inverse - _HALF, _ZERO)
  fy = max((np.float32(py) + _HALF) * inverse - _HALF, _ZERO)
  x0 = min(np.int64(fx), width - 1)
  y0 = min(np.int64(fy), height - 1)
  x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
  fx -= np.float32(x0)
  fy -= np.float32(y0)
  upper = np.float32(pixels[start + (y0 * width + x0) * 3 + c]) * (_ONE - fx)
  upper += np.float32(pixels[start + (y0 * width + x1) * 3 + c]) * fx
  lower = np.float32(pixels[start + (y1 * width + x0) * 3 + c]) * (_ONE - fx)
  lower += np.float32(pixels[start + (y1 * width + x1) * 3 + c]) * fx
  return (upper * (_ONE - fy) + lower * fy) * scale


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def draw_ray(pictures, settings, seed, index, ray):
  """Draws a pixel and a blur, or an anchor; writes what Chunk.rays says to `ray`."""
  images = len(pictures.origins) // 3
  height, width = pictures.heights[0], pictures.widths[0]
  image = min(np.int64(uniform(seed, index, 0) * np.float32(images)), images - 1)
  px = min(np.int64(uniform(seed, index, 1) * np.float32(width)), width - 1)
  py = min(np.int64(uniform(seed, index, 2) * np.float32(height)), height - 1)
  ray[13] = _ZERO
  known = len(pictures.anchors) > 0 and uniform(seed, index, 9) < settings.anchor_fraction
  if known:
    count = len(pictures.anchors) // 4
    at = 4 * min(np.int64(uniform(seed, index, 10) * np.float32(count)), count - 1)
    image = np.int64(pictures.anchors[at])
    px, py = np.int64(pictures.anchors[at + 1]), np.int64(pictures.anchors[at + 2])
    ray[13] = pictures.anchors[at + 3]
  blur = _ZERO
  if not known and settings.blur_max > _ZERO and uniform(seed, index, 3) >= settings.blur_sharp:
    blur = settings.blur_max * np.float32(uniform(seed, index, 4) ** settings.blur_power)
  pixel = 3 * (py * width + px)
  cx, cy, cz = (
    pictures.directions[pixel],
    pictures.directions[pixel + 1],
    pictures.directions[pixel + 2],
  )
  inverse = _ONE / np.sqrt(cx * cx + cy * cy + cz * cz)
  rotation = pictures.rotations[9 * image : 9 * image + 9]
  for i in range(3):
    ray[i] = pictures.origins[3 * image + i]
    ray[3 + i] = inverse * (
      rotation[3 * i] * cx + rotation[3 * i + 1] * cy + rotation[3 * i + 2] * cz
    )
  level = 0
  while level + 1 < len(pictures.blurs) and pictures.blurs[level + 1] <= blur:
    level += 1
  mix = _ZERO
  if level + 1 < len(pictures.blurs):
    low = pictures.blurs[level] * pictures.blurs[level]
    high = pictures.blurs[level + 1] * pictures.blurs[level + 1]
    mix = (blur * blur - low) / (high - low)
  for c in range(3):
    value = _look_up(pictures, level, image, px, py, c)
    if mix > _ZERO:
      value += mix * (_look_up(pictures, level + 1, image, px, py, c) - value)
    ray[6 + c] = value
    ray[10 + c] = uniform(seed, index, 6 + c) if settings.random_background else _ZERO
  ray[9] = _ONE + blur if settings.paper_footprint else _ONE + np.float32(12) * blur * blur


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def spherical_harmonics(x, y, z, row):
  """As encoding.spherical_harmonics."""
  row[0] = np.float32(0.28209479)
  row[1] = np.float32(-0.48860251) * y
  row[2] = np.float32(0.48860251) * z
  row[3] = np.float32(-0.48860251) * x
  row[4] = np.float32(1.09254843) * x * y
  row[5] = np.float32(-1.09254843) * y * z
  row[6] = np.float32(0.31539157) * (np.float32(3) * z * z - _ONE)
  row[7] = np.float32(-1.09254843) * x * z
  row[8] = np.float32(0.54627421) * (x * x - y * y)


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def place(chunk, settings, count, inputs, coordinates):
  """Writes the samples' grid coordinates and variance features."""
  scratch = chunk.d_color
  for n in range(count):
    ray = chunk.rays[14 * chunk.ray_of[n] : 14 * chunk.ray_of[n] + 14]
    t = chunk.distance[n]
    x, y, z = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
    norm = max(_ONE, max(abs(x), max(abs(y), abs(z))))
    u, v, w = squash(x, y, z, norm)
    coordinates[3 * n] = u
    coordinates[3 * n + 1] = v
    coordinates[3 * n + 2] = w
    spread = settings.pixel_angle * t
    across = ray[9] * spread * spread * _TWELFTH
    length = settings.variance_step * norm
    along = length * length * _TWELFTH
    for i in range(3):
      d = ray[3 + i] * ray[3 + i]
      scratch[3 * n + i] = across * (_ONE - d) + along * d + _VARIANCE_FLOOR
  for i in range(3 * count):
    scratch[i] = _LOG_SCALE * fast_log2(scratch[i]) + _ONE
  for n in range(count):
    for i in range(3):
      chunk.x[n * inputs + inputs - 3 + i] = scratch[3 * n + i]


@numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")
def density_of(raw, settings):
  """Density by squareplus, without cancellation for very negative inputs."""
  z = settings.density_gain * raw + settings.density_bias
  root = np.sqrt(z * z + _FOUR)
  ramp = _HALF * (z + root) if z > _ZERO else _TWO / (root - z)
  return settings.density_scale * ramp


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def _keep_visible(chunk, rays, count, inputs, width, outputs, coordinates, threshold):
  """Drops the samples of every ray behind opaque matter; returns how many are left."""
  kept = 0
  for r in range(rays):
    start, stop = chunk.first[r], chunk.first[r + 1]
    chunk.first[r] = kept
    through = _ONE
    for n in range(start, stop):
      chunk.alpha[kept] = chunk.alpha[n]
      chunk.weight[kept] = through * chunk.alpha[n]
      through *= _ONE - chunk.alpha[n]
      chunk.through[kept] = through
      if kept != n:
        chunk.ray_of[kept] = r
        chunk.distance[kept] = chunk.distance[n]
        chunk.length[kept] = chunk.length[n]
        chunk.inverse_std[kept] = chunk.inverse_std[n]
        for i in range(3):
          coordinates[3 * kept + i] = coordinates[3 * n + i]
        for i in range(inputs):
          chunk.x[kept * inputs + i] = chunk.x[n * inputs + i]
        for i in range(width):
          chunk.pre[kept * width + i] = chunk.pre[n * width + i]
        for i in range(width):
          chunk.hidden[kept * width + i] = chunk.hidden[n * width + i]
        for i in range(outputs):
          chunk.out[kept * outputs + i] = chunk.out[n * outputs + i]
      kept += 1
      if through < threshold:
        break
  chunk.first[rays] = kept
  return kept


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def forward(
  chunk, settings, network, table, resolutions, entries, rays, count, coordinates, threshold
):
  """Evaluates the chunk's samples; returns how many of them are visible and kept."""
  features = 2 * len(resolutions)
  inputs = features + 3
  width, outputs = len(network.base_b1), len(network.base_b2)
  place(chunk, settings, count, inputs, coordinates)
  encode(table, resolutions, entries, coordinates, count, chunk.x, inputs)
  base_forward(
    network, chunk.x, inputs, count, chunk.pre, chunk.hidden, chunk.inverse_std, chunk.out
  )
  for n in range(count):
    density = density_of(chunk.out[n * outputs], settings)
    chunk.alpha[n] = _ONE - fast_exp(-density * chunk.length[n])
  count = _keep_visible(chunk, rays, count, inputs, width, outputs, coordinates, threshold)
  for r in range(rays):
    ray = chunk.rays[14 * r : 14 * r + 14]
    spherical_harmonics(ray[3], ray[4], ray[5], chunk.harmonics[9 * r : 9 * r + 9])
  view_offsets(network, chunk.harmonics, rays, chunk.offsets)
  view_forward(
    network,
    chunk.out,
    chunk.ray_of,
    chunk.offsets,
    count,
    settings.specular_bias,
    chunk.view_pre,
    chunk.view_hidden,
    chunk.color,
  )
  return count


@numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")
def _spacing(t):
  """Normalised distance of the distortion loss, see sampling.spacing."""
  return _HALF * t if t < _ONE else _ONE - _HALF / t


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def _ray_losses(chunk, settings, r, outputs):
  """Composites a ray, adds its losses' gradients; returns the squared error and both losses.

  Gradients: dC/dsigma_i = length_i (T_{i+1} c_i - sum_{j>i} w_j c_j), and likewise for the
  distortion loss, whose derivative by w_i is 2 sum_j w_j |m_i - m_j| + 2/3 w_i l_i in O(n).
  """
  ray = chunk.rays[14 * r : 14 * r + 14]
  start, stop = chunk.first[r], chunk.first[r + 1]
  red, green, blue, total, moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
  for n in range(start, stop):
    w = chunk.weight[n]
    red += w * (chunk.color[6 * n] + chunk.color[6 * n + 3])
    green += w * (chunk.color[6 * n + 1] + chunk.color[6 * n + 4])
    blue += w * (chunk.color[6 * n + 2] + chunk.color[6 * n + 5])
    total += w
    moment += w * _spacing(chunk.distance[n])
  rest = _ONE - total
  e0 = red + rest * ray[10] - ray[6]
  e1 = green + rest * ray[11] - ray[7]
  e2 = blue + rest * ray[12] - ray[8]
  pad = settings.charbonnier * settings.charbonnier
  q0, q1, q2 = np.sqrt(e0 * e0 + pad), np.sqrt(e1 * e1 + pad), np.sqrt(e2 * e2 + pad)
  photometric = (q0 + q1 + q2) * _THIRD
  g0, g1, g2 = e0 / q0 * _THIRD, e1 / q1 * _THIRD, e2 / q2 * _THIRD
  behind = g0 * ray[10] + g1 * ray[11] + g2 * ray[12]
  below, moment_below, distortion = _ZERO, _ZERO, _ZERO
  anchored = settings.anchor_weight if ray[13] > _ZERO else _ZERO
  goal = _spacing(ray[13])
  for n in range(start, stop):
    w = chunk.weight[n]
    t, half = chunk.distance[n], chunk.length[n] * _HALF
    m = _spacing(t)
    extent = _spacing(t + half) - _spacing(t - half)
    above = total - below - w
    moment_above = moment - moment_below - w * m
    spread = m * (below - above) - moment_below + moment_above
    distortion += w * spread + w * w * extent * _THIRD
    chunk.d_weight[n] = (
      g0 * (chunk.color[6 * n] + chunk.color[6 * n + 3])
      + g1 * (chunk.color[6 * n + 1] + chunk.color[6 * n + 4])
      + g2 * (chunk.color[6 * n + 2] + chunk.color[6 * n + 5])
      - behind
      + settings.distortion * _TWO * (spread + _THIRD * w * extent)
      + anchored * (abs(m - goal) - (_ONE - goal))
    )
    chunk.d_color[3 * n] = g0 * w
    chunk.d_color[3 * n + 1] = g1 * w
    chunk.d_color[3 * n + 2] = g2 * w
    below += w
    moment_below += w * m
  later = _ZERO
  for back in range(stop - start):
    n = stop - 1 - back
    d_density = chunk.length[n] * (chunk.through[n] * chunk.d_weight[n] - later)
    later += chunk.weight[n] * chunk.d_weight[n]
    z = settings.density_gain * chunk.out[n * outputs] + settings.density_bias
    root = np.sqrt(z * z + _FOUR)
    slope = _HALF * (_ONE + z / root) if z > _ZERO else _TWO / (root * (root - z))
    chunk.d_out[n * outputs] = settings.density_gain * settings.density_scale * d_density * slope
  return (e0 * e0 + e1 * e1 + e2 * e2) * _THIRD, photometric, distortion


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def _push_empty(
  pictures,
  settings,
  network,
  gradient,
  table,
  resolutions,
  entries,
  chunk,
  seed,
  first,
  total,
  rays,
):
  """Adds the gradient of empty_weight * log(1 + density), a mean over points known to be empty.

  It is multiplied by the number of rays, over which the other losses are sums.
  Their samples come behind the `total` that `chunk` holds already; returns how many there are.
  """
  features = 2 * len(resolutions)
  inputs = features + 3
  outputs = len(network.base_b2)
  count, size = settings.empty_samples, settings.empty_size
  weight = settings.empty_weight * np.float32(rays) / np.float32(count)
  coordinates = chunk.coordinates[3 * total :]
  scale = _TWO / np.float32(size)
  for n in range(count):
    index = first + n
    found = np.int64(uniform(seed, index, 16) * np.float32(len(pictures.empty)))
    cell = pictures.empty[min(found, len(pictures.empty) - 1)]
    x = (np.float32(cell // (size * size)) + uniform(seed, index, 17)) * scale - _ONE
    y = (np.float32(cell // size % size) + uniform(seed, index, 18)) * scale - _ONE
    z = (np.float32(cell % size) + uniform(seed, index, 19)) * scale - _ONE
    u, v, w = squash(x, y, z, _ONE)
    coordinates[3 * n] = u
    coordinates[3 * n + 1] = v
    coordinates[3 * n + 2] = w
    # Standard deviations from a thousandth to a tenth of the unit, alike on a logarithmic scale.
    extent = _ONE + np.float32(0.1 * np.log2(10.0)) * (
      np.float32(-3) + _TWO * uniform(seed, index, 20)
    )
    for i in range(3):
      chunk.x[n * inputs + features + i] = extent
  encode(table, resolutions, entries, coordinates, count, chunk.x, inputs)
  base_forward(
    network, chunk.x, inputs, count, chunk.pre, chunk.hidden, chunk.inverse_std, chunk.out
  )
  for n in range(count):
    z = settings.density_gain * chunk.out[n * outputs] + settings.density_bias
    root = np.sqrt(z * z + _FOUR)
    slope = _HALF * (_ONE + z / root) if z > _ZERO else _TWO / (root * (root - z))
    slope *= settings.density_gain * settings.density_scale
    density = density_of(chunk.out[n * outputs], settings)
    for i in range(outputs):
      chunk.d_out[n * outputs + i] = _ZERO
    chunk.d_out[n * outputs] = weight * slope / (_ONE + density)
  base_backward(
    network,
    gradient,
    chunk.x,
    inputs,
    count,
    chunk.pre,
    chunk.hidden,
    chunk.inverse_std,
    chunk.d_out,
    chunk.d_hidden,
    chunk.d_features[features * total :],
  )
  return count


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=KERNEL_CACHE)
def train_rays(
  pictures,
  settings,
  occupancy,
  network,
  gradient,
  table,
  resolutions,
  entries,
  chunk,
  seed,
  first_ray,
  budget,
  threshold,
  figures,
):
  """Adds the gradient of as many random rays as fit into a budget of samples.

  Args:
    pictures, settings, occupancy: What to train on and how.
    network, gradient: Parameters of the networks and where their gradient is added.
    table, resolutions, entries: The hash grid.
    chunk: Work arrays; coordinates and d_features get the samples for the table's gradient.
    seed, first_ray: Ray i of this call is number first_ray + i of the seed's sequence.
    budget: Samples to spend; the last chunk may pass it.
    threshold: Samples behind a transmittance below this are dropped.
    figures: Result float64 [6]: rays, kept samples, marched samples, sums over the rays of squared
      error, Charbonnier loss and distortion loss.
  """
  features = 2 * len(resolutions)
  inputs = features + 3
  outputs = len(network.base_b2)
  capacity = len(chunk.distance)
  rays_done, total, marched = 0, 0, 0
  square_sum, loss_sum, distortion_sum = 0.0, 0.0, 0.0
  while marched < budget:
    rays, count = 0, 0
    while rays < CHUNK_RAYS and count + settings.ray_samples <= capacity:
      ray = chunk.rays[14 * rays : 14 * rays + 14]
      index = first_ray + rays_done + rays
      draw_ray(pictures, settings, seed, index, ray)
      chunk.first[rays] = count
      found = march(
        occupancy,
        ray[0],
        ray[1],
        ray[2],
        ray[3],
        ray[4],
        ray[5],
        settings.near,
        uniform(seed, index, 5),
        settings.step,
        settings.depth_limit,
        settings.ray_samples,
        chunk.distance,
        chunk.length,
        count,
      )
      for n in range(count, count + found):
        chunk.ray_of[n] = rays
      count += found
      rays += 1
    chunk.first[rays] = count
    rays_done += rays
    marched += max(count, 1)
    coordinates = chunk.coordinates[3 * total :]
    count = forward(
      chunk, settings, network, table, resolutions, entries, rays, count, coordinates, threshold
    )
    for r in range(rays):
      square, loss, distortion = _ray_losses(chunk, settings, r, outputs)
      square_sum += square
      loss_sum += loss
      distortion_sum += distortion
    view_backward(
      network,
      gradient,
      chunk.out,
      chunk.ray_of,
      chunk.harmonics,
      rays,
      count,
      chunk.view_pre,
      chunk.view_hidden,
      chunk.color,
      chunk.d_color,
      chunk.d_view,
      chunk.d_rays,
      chunk.d_out,
    )
    base_backward(
      network,
      gradient,
      chunk.x,
      inputs,
      count,
      chunk.pre,
      chunk.hidden,
      chunk.inverse_std,
      chunk.d_out,
      chunk.d_hidden,
      chunk.d_features[features * total :],
    )
    total += count
  if len(pictures.empty) > 0 and settings.empty_samples > 0:
    total += _push_empty(
      pictures,
      settings,
      network,
      gradient,
      table,
      resolutions,
      entries,
      chunk,
      seed,
      first_ray,
      total,
      rays_done,
    )
  figures[0], figures[1], figures[2] = rays_done, total, marched
  figures[3], figures[4], figures[5] = square_sum, loss_sum, distortion_sum


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=KERNEL_CACHE)
def render_rays(
  settings,
  occupancy,
  network,
  table,
  resolutions,
  entries,
  chunk,
  rays_in,
  first,
  stop,
  footprint,
  colors,
  depths,
  opacities,
):
  """Renders rays [first, stop) of rays_in [.., 6] (origin, unit direction).

  Writes colours [.., 3] over black, expected distances (the mean over the weights, 0 where nothing
  was hit) and opacities.
  """
  capacity = len(chunk.distance)
  at = first
  while at < stop:
    rays, count = 0, 0
    while at + rays < stop and rays < CHUNK_RAYS and count + settings.ray_samples <= capacity:
      ray = chunk.rays[14 * rays : 14 * rays + 14]
      for i in range(6):
        ray[i] = rays_in[6 * (at + rays) + i]
      ray[9] = footprint
      chunk.first[rays] = count
      found = march(
        occupancy,
        ray[0],
        ray[1],
        ray[2],
        ray[3],
        ray[4],
        ray[5],
        settings.near,
        _HALF,
        settings.step,
        settings.depth_limit,
        settings.ray_samples,
        chunk.distance,
        chunk.length,
        count,
      )
      for n in range(count, count + found):
        chunk.ray_of[n] = rays
      count += found
      rays += 1
    chunk.first[rays] = count
    count = forward(
      chunk,
      settings,
      network,
      table,
      resolutions,
      entries,
      rays,
      count,
      chunk.coordinates,
      np.float32(1e-3),
    )
    for r in range(rays):
      red, green, blue, total, moment = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
      for n in range(chunk.first[r], chunk.first[r + 1]):
        w = chunk.weight[n]
        red += w * (chunk.color[6 * n] + chunk.color[6 * n + 3])
        green += w * (chunk.color[6 * n + 1] + chunk.color[6 * n + 4])
        blue += w * (chunk.color[6 * n + 2] + chunk.color[6 * n + 5])
        total += w
        moment += w * chunk.distance[n]
      colors[3 * (at + r)] = red
      colors[3 * (at + r) + 1] = green
      colors[3 * (at + r) + 2] = blue
      opacities[at + r] = total
      depths[at + r] = moment / max(total, np.float32(1e-6))
    at += rays


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=KERNEL_CACHE)
def densities(
  settings, network, table, resolutions, entries, chunk, positions, variance, first, stop, result
):
  """Writes the densities at points [first, stop) of positions [.., 3] in the unit frame.

  All points have the same variance, equal along the axes [unit^2].
  """
  features = 2 * len(resolutions)
  inputs = features + 3
  outputs = len(network.base_b2)
  extent = _LOG_SCALE * fast_log2(variance + _VARIANCE_FLOOR) + _ONE
  capacity = len(chunk.distance)
  at = first
  while at < stop:
    count = min(capacity, stop - at)
    for n in range(count):
      x, y, z = positions[3 * (at + n)], positions[3 * (at + n) + 1], positions[3 * (at + n) + 2]
      norm = max(_ONE, max(abs(x), max(abs(y), abs(z))))
      u, v, w = squash(x, y, z, norm)
      chunk.coordinates[3 * n] = u
      chunk.coordinates[3 * n + 1] = v
      chunk.coordinates[3 * n + 2] = w
      for i in range(3):
        chunk.x[n * inputs + features + i] = extent
    encode(table, resolutions, entries, chunk.coordinates, count, chunk.x, inputs)
    base_forward(
      network, chunk.x, inputs, count, chunk.pre, chunk.hidden, chunk.inverse_std, chunk.out
    )
    for n in range(count):
      result[at + n] = density_of(chunk.out[n * outputs], settings)
    at += count
