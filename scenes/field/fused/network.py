"""The field's two small networks in numba, forwards and backwards, for blocks of samples.

Everything is flat float32 and row-major; widths are multiples of 16. Shapes: N samples, R rays,
W width, B bottleneck, V view width, I = 2 L + 3 inputs, O = 4 + B outputs of the base network.
"""

from typing import NamedTuple

import numba
import numpy as np

from nerf2real.scenes.field.fused.fast_math import sigmoid
from nerf2real.scenes.field.fused.matrix_kernels import add_product

_ZERO, _ONE = np.float32(0), np.float32(1)
_EPSILON = np.float32(1e-5)  # layer norm, as in field.layer_norm


class Network(NamedTuple):
  """Parameters of both networks and their transposes, each flat float32."""

  base_w1: np.ndarray  # [I, W]
  base_b1: np.ndarray  # [W]
  base_w2: np.ndarray  # [W, O]
  base_b2: np.ndarray  # [O]
  view_w1: np.ndarray  # [B + 9, V]
  view_b1: np.ndarray  # [V]
  view_w2: np.ndarray  # [3, V], transposed against the field's file
  view_b2: np.ndarray  # [3]
  base_w1_t: np.ndarray  # [W, 2 L]: the features' part of base_w1, transposed
  base_w2_t: np.ndarray  # [O, W]
  view_w1_t: np.ndarray  # [V, O]: the bottleneck's part of view_w1, transposed, behind 4 zeros


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def base_forward(network, x, inputs, count, pre, hidden, inverse_std, out):
  """Evaluates the base network on x [N, I]: pre-activations, normalised hidden units, outputs."""
  width = len(network.base_b1)
  outputs = len(network.base_b2)
  for n in range(count):
    for j in range(width):
      pre[n * width + j] = network.base_b1[j]
    for j in range(outputs):
      out[n * outputs + j] = network.base_b2[j]
  add_product(x, 0, inputs, 1, network.base_w1, 0, width, pre, 0, width, count, inputs, width)
  scale = _ONE / np.float32(width)
  for n in range(count):
    row_pre = pre[n * width : (n + 1) * width]
    row = hidden[n * width : (n + 1) * width]
    total = _ZERO
    for j in range(width):
      value = row_pre[j] * sigmoid(row_pre[j])
      row[j] = value
      total += value
    mean = total * scale
    square = _ZERO
    for j in range(width):
      centred = row[j] - mean
      row[j] = centred
      square += centred * centred
    inverse = _ONE / np.sqrt(square * scale + _EPSILON)
    inverse_std[n] = inverse
    for j in range(width):
      row[j] *= inverse
  add_product(
    hidden, 0, width, 1, network.base_w2, 0, outputs, out, 0, outputs, count, width, outputs
  )


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def base_backward(
  network, gradient, x, inputs, count, pre, hidden, inverse_std, d_out, d_hidden, d_features
):
  """Adds the base network's gradient and writes the features' gradient [N, 2 L]."""
  width = len(network.base_b1)
  outputs = len(network.base_b2)
  features = inputs - 3
  add_product(
    hidden, 0, 1, width, d_out, 0, outputs, gradient.base_w2, 0, outputs, width, count, outputs
  )
  for n in range(count):
    for j in range(outputs):
      gradient.base_b2[j] += d_out[n * outputs + j]
  d_hidden[: count * width] = _ZERO
  add_product(
    d_out, 0, outputs, 1, network.base_w2_t, 0, width, d_hidden, 0, width, count, outputs, width
  )
  scale = _ONE / np.float32(width)
  bias = gradient.base_b1
  for n in range(count):
    row = d_hidden[n * width : (n + 1) * width]
    row_hidden = hidden[n * width : (n + 1) * width]
    row_pre = pre[n * width : (n + 1) * width]
    mean, projection = _ZERO, _ZERO
    for j in range(width):
      mean += row[j]
      projection += row[j] * row_hidden[j]
    mean *= scale
    projection *= scale
    inverse = inverse_std[n]
    for j in range(width):
      s = sigmoid(row_pre[j])
      slope = s * (_ONE + row_pre[j] * (_ONE - s))
      row[j] = inverse * (row[j] - mean - row_hidden[j] * projection) * slope
    for j in range(width):
      bias[j] += row[j]
  add_product(x, 0, 1, inputs, d_hidden, 0, width, gradient.base_w1, 0, width, inputs, count, width)
  d_features[: count * features] = _ZERO
  add_product(
    d_hidden,
    0,
    width,
    1,
    network.base_w1_t,
    0,
    features,
    d_features,
    0,
    features,
    count,
    width,
    features,
  )


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def view_offsets(network, harmonics, rays, offsets):
  """Writes the part of the view network's first layer that a ray's samples share [R, V]."""
  width = len(network.view_b1)
  bottleneck = len(network.base_b2) - 4
  for r in range(rays):
    for j in range(width):
      offsets[r * width + j] = network.view_b1[j]
  add_product(
    harmonics,
    0,
    9,
    1,
    network.view_w1,
    bottleneck * width,
    width,
    offsets,
    0,
    width,
    rays,
    9,
    width,
  )


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def view_forward(network, out, ray_of, offsets, count, specular_bias, pre, hidden, color):
  """Writes the colours: diffuse in color[:, 0:3], specular in color[:, 3:6], after the sigmoids."""
  width = len(network.view_b1)
  outputs = len(network.base_b2)
  for n in range(count):
    ray = ray_of[n]
    for j in range(width):
      pre[n * width + j] = offsets[ray * width + j]
  add_product(
    out, 4, outputs, 1, network.view_w1, 0, width, pre, 0, width, count, outputs - 4, width
  )
  w2 = network.view_w2
  for n in range(count):
    row_pre = pre[n * width : (n + 1) * width]
    row = hidden[n * width : (n + 1) * width]
    for j in range(width):
      row[j] = row_pre[j] * sigmoid(row_pre[j])
    for c in range(3):
      total = network.view_b2[c] + specular_bias
      for j in range(width):
        total += row[j] * w2[c * width + j]
      color[6 * n + 3 + c] = total
      color[6 * n + c] = out[n * outputs + 1 + c]
  for i in range(6 * count):
    color[i] = sigmoid(color[i])


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def view_backward(
  network,
  gradient,
  out,
  ray_of,
  harmonics,
  rays,
  count,
  pre,
  hidden,
  color,
  d_color,
  d_hidden,
  d_rays,
  d_out,
):
  """Adds the view network's gradient and writes d_out[:, 1:] from d_color [N, 3] (overwritten)."""
  width = len(network.view_b1)
  outputs = len(network.base_b2)
  bottleneck = outputs - 4
  w2 = network.view_w2
  d_rays[: rays * width] = _ZERO
  for n in range(count):
    for c in range(3):
      diffuse, specular = color[6 * n + c], color[6 * n + 3 + c]
      upstream = d_color[3 * n + c]
      d_out[n * outputs + 1 + c] = upstream * diffuse * (_ONE - diffuse)
      d_color[3 * n + c] = upstream * specular * (_ONE - specular)
      gradient.view_b2[c] += d_color[3 * n + c]
    for j in range(bottleneck):
      d_out[n * outputs + 4 + j] = _ZERO
  add_product(d_color, 0, 1, 3, hidden, 0, width, gradient.view_w2, 0, width, 3, count, width)
  for n in range(count):
    row = d_hidden[n * width : (n + 1) * width]
    row_pre = pre[n * width : (n + 1) * width]
    g0, g1, g2 = d_color[3 * n], d_color[3 * n + 1], d_color[3 * n + 2]
    for j in range(width):
      s = sigmoid(row_pre[j])
      slope = s * (_ONE + row_pre[j] * (_ONE - s))
      row[j] = (g0 * w2[j] + g1 * w2[width + j] + g2 * w2[2 * width + j]) * slope
    ray = ray_of[n]
    for j in range(width):
      d_rays[ray * width + j] += row[j]
  add_product(
    out, 4, 1, outputs, d_hidden, 0, width, gradient.view_w1, 0, width, bottleneck, count, width
  )
  add_product(
    harmonics,
    0,
    1,
    9,
    d_rays,
    0,
    width,
    gradient.view_w1,
    bottleneck * width,
    width,
    9,
    rays,
    width,
  )
  for r in range(rays):
    for j in range(width):
      gradient.view_b1[j] += d_rays[r * width + j]
  add_product(
    d_hidden, 0, width, 1, network.view_w1_t, 0, outputs, d_out, 0, outputs, count, width, outputs
  )
