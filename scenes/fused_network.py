"""The field's two small networks in numba, forwards and backwards, for blocks of samples.

Everything is flat float32 and row-major; widths are multiples of 16. Shapes: N samples, R rays,
W width, B bottleneck, V view width, I = 2 L + 3 inputs, O = 4 + B outputs of the base network.
"""

from typing import NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from scenes.matrix_kernels import add_product

_ZERO, _ONE, _HALF, _FOUR = (np.float32(x) for x in (0, 1, 0.5, 4))
_EPSILON = np.float32(1e-5)  # layer norm, as in field.layer_norm
_LOG2_E = np.float32(1.4426950408889634)
_LOW, _HIGH = np.float32(-87), np.float32(87)
# 2^f on [-0.5, 0.5], Taylor: relative error 2e-7.
_P1, _P2, _P3, _P4, _P5, _P6 = (
  np.float32(np.log(2) ** k / f) for k, f in enumerate((1, 2, 6, 24, 120, 720), 1)
)


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


@intrinsic
def _float_from_bits(typing_context, bits):
  def codegen(context, builder, signature, arguments):
    return builder.bitcast(arguments[0], ir.FloatType())

  return types.float32(types.int32), codegen


@numba.njit(fastmath=True, nogil=True, inline="always")
def fast_exp(x):
  """exp(x) of a float32 to 3e-7, without a call, so that loops over it vectorise."""
  z = min(max(x, _LOW), _HIGH) * _LOG2_E
  whole = np.int32(z + np.float32(256.5)) - np.int32(256)
  f = z - np.float32(whole)
  power = _ONE + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * (_P5 + f * _P6)))))
  return power * _float_from_bits(np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)))


@numba.njit(fastmath=True, nogil=True, inline="always")
def sigmoid(x):
  """1 / (1 + exp(-x)) of a float32."""
  return _ONE / (_ONE + fast_exp(-x))


@numba.njit(fastmath=True, nogil=True)
def base_forward(network, x, inputs, count, pre, hidden, inverse_std, out):
  """Evaluates the base network on x [N, I]: pre-activations, normalised hidden units, outputs."""
  width = len(network.base_b1)
  outputs = len(network.base_b2)
  for n in range(count):
    for j in range(width):
      pre[n * width + j] = network.base_b1[j]
    for j in range(outputs):
      out[n * outputs + j] = network.base_b2[j]
  add_product(
    x, 0, inputs, 1, network.base_w1, 0, width, pre, 0, width, count, inputs, width
  )  # fmt: skip
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


@numba.njit(fastmath=True, nogil=True)
def base_backward(
  network, gradient, x, inputs, count, pre, hidden, inverse_std, d_out, d_hidden, d_features
):  # fmt: skip
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
  add_product(
    x, 0, 1, inputs, d_hidden, 0, width, gradient.base_w1, 0, width, inputs, count, width
  )
  d_features[: count * features] = _ZERO
  add_product(
    d_hidden, 0, width, 1, network.base_w1_t, 0, features,
    d_features, 0, features, count, width, features,
  )  # fmt: skip


@numba.njit(fastmath=True, nogil=True)
def view_offsets(network, harmonics, rays, offsets):
  """Writes the part of the view network's first layer that a ray's samples share [R, V]."""
  width = len(network.view_b1)
  bottleneck = len(network.base_b2) - 4
  for r in range(rays):
    for j in range(width):
      offsets[r * width + j] = network.view_b1[j]
  add_product(
    harmonics, 0, 9, 1, network.view_w1, bottleneck * width, width,
    offsets, 0, width, rays, 9, width,
  )  # fmt: skip


@numba.njit(fastmath=True, nogil=True)
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


@numba.njit(fastmath=True, nogil=True)
def view_backward(
  network, gradient, out, ray_of, harmonics, rays, count, pre, hidden, color, d_color,
  d_hidden, d_rays, d_out,
):  # fmt: skip
  """Adds the view network's gradient and writes d_out[:, 1:] from d_color [N, 3]."""
  width = len(network.view_b1)
  outputs = len(network.base_b2)
  bottleneck = outputs - 4
  w2 = network.view_w2
  d_rays[: rays * width] = _ZERO
  for n in range(count):
    row = d_hidden[n * width : (n + 1) * width]
    row_hidden = hidden[n * width : (n + 1) * width]
    row_pre = pre[n * width : (n + 1) * width]
    s0, s1, s2 = color[6 * n + 3], color[6 * n + 4], color[6 * n + 5]
    g0 = d_color[3 * n] * s0 * (_ONE - s0)
    g1 = d_color[3 * n + 1] * s1 * (_ONE - s1)
    g2 = d_color[3 * n + 2] * s2 * (_ONE - s2)
    for c in range(3):
      diffuse = color[6 * n + c]
      d_out[n * outputs + 1 + c] = d_color[3 * n + c] * diffuse * (_ONE - diffuse)
    for j in range(bottleneck):
      d_out[n * outputs + 4 + j] = _ZERO
    gradient.view_b2[0] += g0
    gradient.view_b2[1] += g1
    gradient.view_b2[2] += g2
    ray = ray_of[n]
    for j in range(width):
      gradient.view_w2[j] += g0 * row_hidden[j]
      gradient.view_w2[width + j] += g1 * row_hidden[j]
      gradient.view_w2[2 * width + j] += g2 * row_hidden[j]
      s = sigmoid(row_pre[j])
      slope = s * (_ONE + row_pre[j] * (_ONE - s))
      row[j] = (g0 * w2[j] + g1 * w2[width + j] + g2 * w2[2 * width + j]) * slope
    for j in range(width):
      d_rays[ray * width + j] += row[j]
  add_product(
    out, 4, 1, outputs, d_hidden, 0, width, gradient.view_w1, 0, width, bottleneck, count, width
  )
  add_product(
    harmonics, 0, 1, 9, d_rays, 0, width,
    gradient.view_w1, bottleneck * width, width, 9, rays, width,
  )  # fmt: skip
  for r in range(rays):
    for j in range(width):
      gradient.view_b1[j] += d_rays[r * width + j]
  add_product(
    d_hidden, 0, width, 1, network.view_w1_t, 0, outputs, d_out, 0, outputs, count, width, outputs
  )
