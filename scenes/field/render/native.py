"""The field's networks as C++ snippets for one sample, that Warp compiles for CPU and CUDA.

Loops run over levels and neurons with constant bounds, so that clang turns them into vector
instructions; Warp's own vector types keep such loops scalar or spill (measured: 2.6 times slower).
The formulas are `engine.native`'s, with one sample a `Vec`; upper-case names are compiled in.

Packed weights (see `scenes.field.render.weights`), all float32, row-major:
  base: bias [W], variance rows [3, W], first features [P, W], second features [P, W],
        output rows [W, O], output bias [O];
  view: bias [V], harmonics rows [9, V], bottleneck rows [B, V], output rows [3, V], output bias 3.
"""

# (position in the grid [0, 1]^3, variance [unit^2]) -> density [1/unit], diffuse 3, bottleneck B.
BASE = r"""
  const float* w = weights.data;
  const unsigned* entries = (const unsigned*)table.data;
  const int* level = (const int*)levels.data;  // 5 rows, see render.weights
  alignas(64) float fx[PADDED], fy[PADDED], fz[PADDED], first[PADDED], second[PADDED];
  alignas(64) int ix[PADDED], iy[PADDED], iz[PADDED];
  alignas(64) int start[PADDED], sy[PADDED], sz[PADDED], mask[PADDED];
  VECTORISE for (int l = 0; l < PADDED; ++l) {
    int cells = level[4 * PADDED + l];
    start[l] = level[l];
    sy[l] = level[PADDED + l];
    sz[l] = level[2 * PADDED + l];
    mask[l] = level[3 * PADDED + l];
    ix[l] = Math::lower(p[0], cells, fx[l]);
    iy[l] = Math::lower(p[1], cells, fy[l]) * sy[l];
    iz[l] = Math::lower(p[2], cells, fz[l]) * sz[l];
    first[l] = 0.0f;
    second[l] = 0.0f;
  }
  for (int corner = 0; corner < 8; ++corner) {
    VECTORISE for (int l = 0; l < PADDED; ++l) {
      int index = Math::entry(ix[l] + (corner & 1), iy[l] + ((corner & 2) ? sy[l] : 0),
                              iz[l] + ((corner & 4) ? sz[l] : 0), mask[l]);
      unsigned pair = entries[start[l] + index];
      float part = ((corner & 1) ? fx[l] : 1.0f - fx[l]) * ((corner & 2) ? fy[l] : 1.0f - fy[l])
                   * ((corner & 4) ? fz[l] : 1.0f - fz[l]);
      first[l] += part * (float)((int)(pair << 16) >> 16);
      second[l] += part * (float)((int)pair >> 16);
    }
  }

  alignas(64) float spread[4];
  VECTORISE for (int k = 0; k < 4; ++k) spread[k] = Math::extent(k < 3 ? v[k] : 1.0f);
  alignas(64) float h[WIDTH];
  VECTORISE for (int j = 0; j < WIDTH; ++j)
    h[j] = w[j] + spread[0] * w[WIDTH + j] + spread[1] * w[2 * WIDTH + j]
           + spread[2] * w[3 * WIDTH + j];
  const float* rows = w + 4 * WIDTH;
  for (int i = 0; i < PADDED; ++i) {
    float a = first[i], b = second[i];
    VECTORISE for (int j = 0; j < WIDTH; ++j)
      h[j] += a * rows[i * WIDTH + j] + b * rows[(PADDED + i) * WIDTH + j];
  }
  float sum = 0.0f, squares = 0.0f;
  VECTORISE for (int j = 0; j < WIDTH; ++j) {
    float y = h[j] * Math::sigmoid(h[j]);
    h[j] = y;
    sum += y;
    squares += y * y;
  }
  float mean = sum * (1.0f / WIDTH);
  float spread_squared = squares * (1.0f / WIDTH) - mean * mean;
  float gain = 1.0f / sqrtf((spread_squared > 0.0f ? spread_squared : 0.0f) + 1e-5f);

  rows += 2 * PADDED * WIDTH;  // the layer norm's mean is already taken out of these rows
  alignas(64) float even[OUTPUTS], odd[OUTPUTS], third[OUTPUTS], fourth[OUTPUTS];
  VECTORISE for (int k = 0; k < OUTPUTS; ++k) even[k] = odd[k] = third[k] = fourth[k] = 0.0f;
  for (int j = 0; j < WIDTH; j += 4) {
    VECTORISE for (int k = 0; k < OUTPUTS; ++k) {
      even[k] += h[j] * rows[j * OUTPUTS + k];
      odd[k] += h[j + 1] * rows[(j + 1) * OUTPUTS + k];
      third[k] += h[j + 2] * rows[(j + 2) * OUTPUTS + k];
      fourth[k] += h[j + 3] * rows[(j + 3) * OUTPUTS + k];
    }
  }
  wp::vec_t<OUTPUTS, wp::float32> out;
  VECTORISE for (int k = 0; k < OUTPUTS; ++k)
    out[k] = ((even[k] + odd[k]) + (third[k] + fourth[k])) * gain + rows[WIDTH * OUTPUTS + k];
  out[0] = DENSITY_SCALE * Math::squareplus(out[0]);
  return out;
"""

# Unit direction -> the view network's hidden layer without the bottleneck's share; once a ray.
VIEW_HIDDEN = r"""
  const float* w = weights.data;
  float harmonics[9];
  Math::harmonics(d[0], d[1], d[2], harmonics);
  wp::vec_t<VIEW, wp::float32> out;
  VECTORISE for (int j = 0; j < VIEW; ++j) {
    float total = w[j];
    for (int i = 0; i < 9; ++i) total += harmonics[i] * w[(i + 1) * VIEW + j];
    out[j] = total;
  }
  return out;
"""

# What BASE gave -> diffuse colour.
DIFFUSE = r"""
  alignas(16) float raw[4] = {base[1], base[2], base[3], 0.0f};
  VECTORISE for (int k = 0; k < 4; ++k) raw[k] = Math::sigmoid(raw[k]);
  return wp::vec3(raw[0], raw[1], raw[2]);
"""

# (what BASE gave, what VIEW_HIDDEN gave) -> specular colour.
SPECULAR = r"""
  const float* w = weights.data + 10 * VIEW;
  alignas(64) float h[VIEW];
  VECTORISE for (int j = 0; j < VIEW; ++j) h[j] = hidden[j];
  for (int i = 0; i < BOTTLENECK; ++i) {
    float a = base[4 + i];
    VECTORISE for (int j = 0; j < VIEW; ++j) h[j] += a * w[i * VIEW + j];
  }
  w += BOTTLENECK * VIEW;
  float r = 0.0f, g = 0.0f, b = 0.0f;
  VECTORISE for (int j = 0; j < VIEW; ++j) {
    float y = h[j] * Math::sigmoid(h[j]);
    r += y * w[j];
    g += y * w[VIEW + j];
    b += y * w[2 * VIEW + j];
  }
  w += 3 * VIEW;
  alignas(16) float raw[4] = {r + w[0], g + w[1], b + w[2], 0.0f};
  VECTORISE for (int k = 0; k < 4; ++k) raw[k] = Math::sigmoid(raw[k]);
  return wp::vec3(raw[0], raw[1], raw[2]);
"""

# 1 - e^-x for x >= 0, without cancellation for small x.
OPACITY = r"""
  return x < 0.01f ? x - 0.5f * x * x : 1.0f - Math::exponential(-x);
"""
