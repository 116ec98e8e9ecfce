"""The field's networks as C++ snippets that Warp compiles for CPU and CUDA.

Loops run over lanes (levels, neurons) with constant bounds, so that clang turns them into vector
instructions; Warp's own vector types keep such loops scalar or spill (measured: 2.6 times slower).
The exponential is a polynomial, because a call of expf cannot be vectorised.
Each snippet is the body of one function; `header` gives the constants that it reads.

Packed weights (see `scenes.field.render.weights`), all float32, row-major:
  base: bias [W], variance rows [3, W], first features [P, W], second features [P, W],
        output rows [W, O], output bias [O];
  view: bias [V], harmonics rows [9, V], bottleneck rows [B, V], output rows [3, V], output bias 3.
"""

_PRELUDE = r"""
#if defined(__CUDACC__)
#define LANES _Pragma("unroll")
#else
#define LANES _Pragma("clang loop vectorize(enable)")
#endif
  // e^x by range reduction and a polynomial: relative error 2e-6.
  auto exponential = [](float x) {
    float y = x * 1.44269504f;
    y = y > 126.0f ? 126.0f : y;
    y = y < -126.0f ? -126.0f : y;
    int whole = (int)(y + (y < 0.0f ? -0.5f : 0.5f));
    float part = y - (float)whole;
    float power = 1.0f + part * (0.69314718f + part * (0.24022651f + part * (0.05550411f
                  + part * (0.00961813f + part * 0.00133336f))));
    union { float f; int i; } bits;
    bits.f = power;
    bits.i += whole << 23;
    return bits.f;
  };
"""

# (position in the grid [0, 1]^3, variance [unit^2]) -> density [1/unit], diffuse 3, bottleneck B.
BASE = r"""
  const float* w = weights.data;
  const unsigned* entries = (const unsigned*)table.data;
  const unsigned* level = (const unsigned*)levels.data;  // 5 rows, see render_weights
  alignas(64) float fx[PADDED], fy[PADDED], fz[PADDED], first[PADDED], second[PADDED];
  alignas(64) unsigned ix[PADDED], iy[PADDED], iz[PADDED];
  alignas(64) unsigned start[PADDED], sy[PADDED], sz[PADDED], mask[PADDED];
  LANES for (int l = 0; l < PADDED; ++l) {
    int cells = (int)level[4 * PADDED + l];
    float x = p[0] * (float)cells, y = p[1] * (float)cells, z = p[2] * (float)cells;
    int a = (int)x, b = (int)y, c = (int)z;
    a = a < cells - 1 ? a : cells - 1;
    b = b < cells - 1 ? b : cells - 1;
    c = c < cells - 1 ? c : cells - 1;
    fx[l] = x - (float)a;
    fy[l] = y - (float)b;
    fz[l] = z - (float)c;
    start[l] = level[l];
    sy[l] = level[PADDED + l];
    sz[l] = level[2 * PADDED + l];
    mask[l] = level[3 * PADDED + l];
    ix[l] = (unsigned)a;
    iy[l] = (unsigned)b * sy[l];
    iz[l] = (unsigned)c * sz[l];
    first[l] = 0.0f;
    second[l] = 0.0f;
  }
  for (int corner = 0; corner < 8; ++corner) {
    LANES for (int l = 0; l < PADDED; ++l) {
      unsigned a = ix[l] + (corner & 1);
      unsigned b = iy[l] + ((corner & 2) ? sy[l] : 0u);
      unsigned c = iz[l] + ((corner & 4) ? sz[l] : 0u);
      unsigned index = mask[l] ? ((a ^ b ^ c) & mask[l]) : a + b + c;
      unsigned pair = entries[start[l] + index];
      float part = ((corner & 1) ? fx[l] : 1.0f - fx[l]) * ((corner & 2) ? fy[l] : 1.0f - fy[l])
                   * ((corner & 4) ? fz[l] : 1.0f - fz[l]);
      first[l] += part * (float)((int)(pair << 16) >> 16);
      second[l] += part * (float)((int)pair >> 16);
    }
  }

  alignas(64) float spread[4];  // log2(variance) / 20 + 1
  LANES for (int k = 0; k < 4; ++k) {
    union { float f; int i; } bits;
    bits.f = (k < 3 ? v[k] : 1.0f) + 1e-10f;
    float power = (float)((bits.i >> 23) - 127);
    bits.i = (bits.i & 0x007fffff) | 0x3f800000;
    float m = bits.f - 1.0f;
    float fraction = m * (1.44196522f + m * (-0.709659f + m * (0.41758426f
                     + m * (-0.1962559f + m * 0.04637971f))));
    spread[k] = 0.05f * (power + fraction) + 1.0f;
  }
  alignas(64) float h[WIDTH];
  LANES for (int j = 0; j < WIDTH; ++j)
    h[j] = w[j] + spread[0] * w[WIDTH + j] + spread[1] * w[2 * WIDTH + j]
           + spread[2] * w[3 * WIDTH + j];
  const float* rows = w + 4 * WIDTH;
  for (int i = 0; i < PADDED; ++i) {
    float a = first[i], b = second[i];
    LANES for (int j = 0; j < WIDTH; ++j)
      h[j] += a * rows[i * WIDTH + j] + b * rows[(PADDED + i) * WIDTH + j];
  }
  float sum = 0.0f, squares = 0.0f;
  LANES for (int j = 0; j < WIDTH; ++j) {
    float y = h[j] / (1.0f + exponential(-h[j]));
    h[j] = y;
    sum += y;
    squares += y * y;
  }
  float mean = sum * (1.0f / WIDTH);
  float spread_squared = squares * (1.0f / WIDTH) - mean * mean;
  float gain = 1.0f / sqrtf((spread_squared > 0.0f ? spread_squared : 0.0f) + 1e-5f);

  rows += 2 * PADDED * WIDTH;  // the layer norm's mean is already taken out of these rows
  alignas(64) float even[OUTPUTS], odd[OUTPUTS], third[OUTPUTS], fourth[OUTPUTS];
  LANES for (int k = 0; k < OUTPUTS; ++k) even[k] = odd[k] = third[k] = fourth[k] = 0.0f;
  for (int j = 0; j < WIDTH; j += 4) {
    LANES for (int k = 0; k < OUTPUTS; ++k) {
      even[k] += h[j] * rows[j * OUTPUTS + k];
      odd[k] += h[j + 1] * rows[(j + 1) * OUTPUTS + k];
      third[k] += h[j + 2] * rows[(j + 2) * OUTPUTS + k];
      fourth[k] += h[j + 3] * rows[(j + 3) * OUTPUTS + k];
    }
  }
  wp::vec_t<OUTPUTS, wp::float32> out;
  LANES for (int k = 0; k < OUTPUTS; ++k)
    out[k] = ((even[k] + odd[k]) + (third[k] + fourth[k])) * gain + rows[WIDTH * OUTPUTS + k];
  float raw = out[0];
  float root = sqrtf(raw * raw + 4.0f);
  out[0] = DENSITY_SCALE * (raw > 0.0f ? 0.5f * (raw + root) : 2.0f / (root - raw));
  return out;
"""

# Unit direction -> the view network's hidden layer without the bottleneck's share; once a ray.
VIEW_HIDDEN = r"""
  const float* w = weights.data;
  float x = d[0], y = d[1], z = d[2];
  float harmonics[9] = {0.28209479f, -0.48860251f * y, 0.48860251f * z, -0.48860251f * x,
    1.09254843f * x * y, -1.09254843f * y * z, 0.31539157f * (3.0f * z * z - 1.0f),
    -1.09254843f * x * z, 0.54627421f * (x * x - y * y)};
  wp::vec_t<VIEW, wp::float32> out;
  LANES for (int j = 0; j < VIEW; ++j) {
    float total = w[j];
    for (int i = 0; i < 9; ++i) total += harmonics[i] * w[(i + 1) * VIEW + j];
    out[j] = total;
  }
  return out;
"""

# What BASE gave -> diffuse colour.
DIFFUSE = r"""
  alignas(16) float raw[4] = {base[1], base[2], base[3], 0.0f};
  LANES for (int k = 0; k < 4; ++k) raw[k] = 1.0f / (1.0f + exponential(-raw[k]));
  return wp::vec3(raw[0], raw[1], raw[2]);
"""

# (what BASE gave, what VIEW_HIDDEN gave) -> specular colour.
SPECULAR = r"""
  const float* w = weights.data + 10 * VIEW;
  alignas(64) float h[VIEW];
  LANES for (int j = 0; j < VIEW; ++j) h[j] = hidden[j];
  for (int i = 0; i < BOTTLENECK; ++i) {
    float a = base[4 + i];
    LANES for (int j = 0; j < VIEW; ++j) h[j] += a * w[i * VIEW + j];
  }
  w += BOTTLENECK * VIEW;
  float r = 0.0f, g = 0.0f, b = 0.0f;
  LANES for (int j = 0; j < VIEW; ++j) {
    float y = h[j] / (1.0f + exponential(-h[j]));
    r += y * w[j];
    g += y * w[VIEW + j];
    b += y * w[2 * VIEW + j];
  }
  w += 3 * VIEW;
  alignas(16) float raw[4] = {r + w[0], g + w[1], b + w[2], 0.0f};
  LANES for (int k = 0; k < 4; ++k) raw[k] = 1.0f / (1.0f + exponential(-raw[k]));
  return wp::vec3(raw[0], raw[1], raw[2]);
"""

# 1 - e^-x for x >= 0, without cancellation for small x.
OPACITY = r"""
  return x < 0.01f ? x - 0.5f * x * x : 1.0f - exponential(-x);
"""


def snippet(body: str, **constants: int | float) -> str:
  """Returns a function body with the constants that it reads in front."""
  lines = [
    f"constexpr {'int' if isinstance(value, int) else 'float'} {name} = {value!r}"
    f"{'' if isinstance(value, int) else 'f'};"
    for name, value in constants.items()
  ]
  return "\n".join(lines) + _PRELUDE + body
