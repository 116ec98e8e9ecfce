"""The field's two networks, forwards and backwards, as C++ snippets on samples [begin, end).

`begin` is a multiple of BLOCK; up to BLOCK - 1 samples behind `end` are worked on, too. Upper-case
names are compiled in: rows of the work array (`layout.Rows`) and the networks' widths.

Shapes: I = 2 L + 3 inputs, W width, O = 4 + B outputs, V view width.
"""

# The base network: inputs -> hidden units (layer norm), their slopes before it, outputs.
BASE_FORWARD = r"""
  const float* w1 = model.weights.data;  // [I + 1, W], the bias is the last row
  const float* b1 = w1 + INPUTS * WIDTH;
  const float* w2 = b1 + WIDTH;  // [W + 1, O]
  const float* b2 = w2 + WIDTH * OUTPUTS;
  for (int n = begin; n < end; n += BLOCK) {
    float* at = worker.work.data + n;
    alignas(64) float scratch[WIDTH * BLOCK];
    Vec sum[VECS], squares[VECS];
    UNROLL for (int v = 0; v < VECS; ++v) sum[v] = squares[v] = Math::same(0.0f);
    for (int j = 0; j < WIDTH; j += TILE) {
      Vec pre[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) pre[t][v] = Math::same(b1[j + t]);
      Math::product(pre, at + INPUT * stride, stride, INPUTS, w1 + j, WIDTH, 1);
      UNROLL for (int t = 0; t < TILE; ++t) {
        UNROLL for (int v = 0; v < VECS; ++v) {
          Vec s = Math::sigmoid(pre[t][v]);
          Vec y = pre[t][v] * s;
          Math::store(at + (SLOPE + j + t) * stride + v * LANES, s + y * (1.0f - s));
          Math::store(scratch + (j + t) * BLOCK + v * LANES, y);
          sum[v] += y;
          squares[v] += y * y;
        }
      }
    }
    Vec mean[VECS], gain[VECS];
    UNROLL for (int v = 0; v < VECS; ++v) {
      mean[v] = sum[v] * (1.0f / WIDTH);
      Vec variance = squares[v] * (1.0f / WIDTH) - mean[v] * mean[v];
      gain[v] = 1.0f / Math::root(Math::greater(variance, Math::same(0.0f)) + 1e-5f);
      Math::store(at + GAIN * stride + v * LANES, gain[v]);
    }
    for (int j = 0; j < WIDTH; ++j)
      UNROLL for (int v = 0; v < VECS; ++v)
        Math::store(at + (HIDDEN + j) * stride + v * LANES,
                    (Math::load(scratch + j * BLOCK + v * LANES) - mean[v]) * gain[v]);
    for (int k = 0; k < OUTPUTS; k += TILE) {
      Vec out[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) out[t][v] = Math::same(b2[k + t]);
      Math::product(out, at + HIDDEN * stride, stride, WIDTH, w2 + k, OUTPUTS, 1);
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v)
          Math::store(at + (OUT + k + t) * stride + v * LANES, out[t][v]);
    }
  }
"""

# The view network and the colours: diffuse in COLOR, specular behind it.
VIEW_FORWARD = r"""
  const float* w1 = model.weights.data + VIEW_AT;  // [B + 10, V], the bias is the last row
  const float* b1 = w1 + (BOTTLENECK + 9) * VIEW;
  const float* w2 = b1 + VIEW;  // [V + 1, 3]
  for (int n = begin; n < end; n += BLOCK) {
    float* at = worker.work.data + n;
    UNROLL for (int v = 0; v < VECS; ++v) {
      Vec d[3];
      UNROLL for (int i = 0; i < 3; ++i)
        UNROLL for (int k = 0; k < LANES; ++k)
          LANE(d[i], k) = worker.rays.data[(3 + i) * RAYS + worker.ray_of.data[n + v * LANES + k]];
      Vec harmonics[9];
      Math::harmonics(d[0], d[1], d[2], harmonics);
      UNROLL for (int i = 0; i < 9; ++i)
        Math::store(at + (OUT + OUTPUTS + i) * stride + v * LANES, harmonics[i]);
    }
    Vec rgb[3][VECS];
    UNROLL for (int c = 0; c < 3; ++c)
      UNROLL for (int v = 0; v < VECS; ++v)
        rgb[c][v] = Math::same(w2[3 * VIEW + c] + settings.specular_bias);
    for (int j = 0; j < VIEW; j += TILE) {
      Vec pre[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) pre[t][v] = Math::same(b1[j + t]);
      Math::product(pre, at + (OUT + 4) * stride, stride, BOTTLENECK + 9, w1 + j, VIEW, 1);
      UNROLL for (int t = 0; t < TILE; ++t) {
        UNROLL for (int v = 0; v < VECS; ++v) {
          Vec s = Math::sigmoid(pre[t][v]);
          Vec y = pre[t][v] * s;
          Math::store(at + (VIEW_SLOPE + j + t) * stride + v * LANES, s + y * (1.0f - s));
          Math::store(at + (VIEW_HIDDEN + j + t) * stride + v * LANES, y);
          UNROLL for (int c = 0; c < 3; ++c) rgb[c][v] += w2[3 * (j + t) + c] * y;
        }
      }
    }
    UNROLL for (int c = 0; c < 3; ++c) {
      UNROLL for (int v = 0; v < VECS; ++v) {
        Vec diffuse = Math::load(at + (OUT + 1 + c) * stride + v * LANES);
        Math::store(at + (COLOR + c) * stride + v * LANES, Math::sigmoid(diffuse));
        Math::store(at + (COLOR + 3 + c) * stride + v * LANES, Math::sigmoid(rgb[c][v]));
      }
    }
  }
"""

# D_COLOR -> D_OUT but for the density's row. D_COLOR and VIEW_SLOPE become the gradients before the
# specular sigmoid and before the hidden units' activation.
VIEW_BACKWARD = r"""
  const float* w1 = model.weights.data + VIEW_AT;
  const float* w2 = w1 + (BOTTLENECK + 10) * VIEW;
  for (int n = begin; n < end; n += BLOCK) {
    float* at = worker.work.data + n;
    Vec upstream[3][VECS];
    UNROLL for (int c = 0; c < 3; ++c) {
      UNROLL for (int v = 0; v < VECS; ++v) {
        Vec diffuse = Math::load(at + (COLOR + c) * stride + v * LANES);
        Vec specular = Math::load(at + (COLOR + 3 + c) * stride + v * LANES);
        Vec d = Math::load(at + (D_COLOR + c) * stride + v * LANES);
        Math::store(at + (D_OUT + 1 + c) * stride + v * LANES, d * diffuse * (1.0f - diffuse));
        upstream[c][v] = d * specular * (1.0f - specular);
        Math::store(at + (D_COLOR + c) * stride + v * LANES, upstream[c][v]);
      }
    }
    for (int j = 0; j < VIEW; ++j) {
      UNROLL for (int v = 0; v < VECS; ++v) {
        float* slope = at + (VIEW_SLOPE + j) * stride + v * LANES;
        Vec d = w2[3 * j] * upstream[0][v] + w2[3 * j + 1] * upstream[1][v]
                + w2[3 * j + 2] * upstream[2][v];
        Math::store(slope, Math::load(slope) * d);
      }
    }
    // The first 4 outputs do not reach the view network: TILE rows from the 5th on.
    for (int k = 0; k < BOTTLENECK; k += TILE) {
      Vec out[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) out[t][v] = Math::same(0.0f);
      Math::product(out, at + VIEW_SLOPE * stride, stride, VIEW, w1 + k * VIEW, 1, VIEW);
      UNROLL for (int t = 0; t < TILE; ++t)
        if (k + t < BOTTLENECK)
          UNROLL for (int v = 0; v < VECS; ++v)
            Math::store(at + (D_OUT + 4 + k + t) * stride + v * LANES, out[t][v]);
    }
  }
"""

# D_OUT -> the features' gradient, behind the coordinates in column kept_at + n of `kept`.
# SLOPE becomes the gradient before the hidden units' activation.
BASE_BACKWARD = r"""
  const float* w1 = model.weights.data;
  const float* w2 = w1 + (INPUTS + 1) * WIDTH;
  for (int n = begin; n < end; n += BLOCK) {
    float* at = worker.work.data + n;
    float* kept = worker.kept.data + kept_at + n;
    alignas(64) float scratch[WIDTH * BLOCK];
    Vec mean[VECS], projection[VECS], gain[VECS];
    UNROLL for (int v = 0; v < VECS; ++v) {
      mean[v] = projection[v] = Math::same(0.0f);
      gain[v] = Math::load(at + GAIN * stride + v * LANES);
    }
    for (int j = 0; j < WIDTH; j += TILE) {
      Vec d[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) d[t][v] = Math::same(0.0f);
      Math::product(d, at + D_OUT * stride, stride, OUTPUTS, w2 + j * OUTPUTS, 1, OUTPUTS);
      UNROLL for (int t = 0; t < TILE; ++t) {
        UNROLL for (int v = 0; v < VECS; ++v) {
          mean[v] += d[t][v];
          projection[v] += d[t][v] * Math::load(at + (HIDDEN + j + t) * stride + v * LANES);
          Math::store(scratch + (j + t) * BLOCK + v * LANES, d[t][v]);
        }
      }
    }
    UNROLL for (int v = 0; v < VECS; ++v) {
      mean[v] *= 1.0f / WIDTH;
      projection[v] *= 1.0f / WIDTH;
    }
    for (int j = 0; j < WIDTH; ++j) {
      UNROLL for (int v = 0; v < VECS; ++v) {
        float* slope = at + (SLOPE + j) * stride + v * LANES;
        Vec d = Math::load(scratch + j * BLOCK + v * LANES) - mean[v]
                - Math::load(at + (HIDDEN + j) * stride + v * LANES) * projection[v];
        Math::store(slope, Math::load(slope) * (gain[v] * d));
      }
    }
    for (int i = 0; i < 2 * LEVELS; i += TILE) {
      Vec d[TILE][VECS];
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v) d[t][v] = Math::same(0.0f);
      Math::product(d, at + SLOPE * stride, stride, WIDTH, w1 + i * WIDTH, 1, WIDTH);
      UNROLL for (int t = 0; t < TILE; ++t)
        UNROLL for (int v = 0; v < VECS; ++v)
          Math::store(kept + (3 + i + t) * worker.kept_stride + v * LANES, d[t][v]);
    }
    UNROLL for (int i = 0; i < 3; ++i)
      UNROLL for (int v = 0; v < VECS; ++v)
        Math::store(kept + i * worker.kept_stride + v * LANES,
                    Math::load(at + (PLACE_U + i) * stride + v * LANES));
  }
"""

# Sums over samples of products of two rows, a tile of ROWS x TILE of them.
_OUTER = r"""
    INLINE void rows_ROWS(const float* x, const float* d, int columns, int begin, int end,
                          float* gradient, int inner, int outer) {
      Vec sums[ROWS][TILE];
      UNROLL for (int r = 0; r < ROWS; ++r)
        UNROLL for (int t = 0; t < TILE; ++t) sums[r][t] = Math::same(0.0f);
      for (int n = begin; n < end; n += LANES) {
        Vec value[ROWS];
        UNROLL for (int r = 0; r < ROWS; ++r) value[r] = Math::load(x + r * stride + n);
        UNROLL for (int t = 0; t < TILE; ++t) {
          Vec slope = Math::load(d + t * stride + n);
          UNROLL for (int r = 0; r < ROWS; ++r) sums[r][t] += value[r] * slope;
        }
      }
      UNROLL for (int r = 0; r < ROWS; ++r)
        UNROLL for (int t = 0; t < TILE; ++t)
          if (t < columns) ADD(gradient[r * inner + t * outer], Math::total(sums[r][t]));
    }
"""

# Adds the parameters' gradient, from what the backward snippets left. Of the tiles of the four
# matrices, part k of `parts` does every parts-th: all of them on a CPU, where parts = 1.
NETWORK_GRADIENT = (
  r"""
  struct Outer {
"""
  + _OUTER.replace("ROWS", "3")
  + _OUTER.replace("ROWS", "1")
  + r"""
    int begin, end, part, parts;
    // gradient[i * inner + j * outer] += sum_n x[i, n] d[j, n]; d has a multiple of TILE rows.
    void add(const float* x, int rows, const float* d, int columns, float* gradient, int inner,
             int outer) {
      for (int i = 0; i < rows; i += i + 3 <= rows ? 3 : 1) {
        for (int j = 0; j < columns; j += TILE) {
          bool mine = part == 0;
          part = mine ? parts - 1 : part - 1;
          if (!mine) continue;
          const float* left = x + i * stride;
          const float* right = d + j * stride;
          float* to = gradient + i * inner + j * outer;
          if (i + 3 <= rows)
            rows_3(left, right, columns - j, begin, end, to, inner, outer);
          else
            rows_1(left, right, columns - j, begin, end, to, inner, outer);
        }
      }
    }
  };
  const float* at = worker.work.data;
  float* base = worker.gradient.data;
  float* view = base + VIEW_AT;
  Outer sums = {begin, end, part, parts};
  sums.add(at + INPUT * stride, INPUTS + 1, at + SLOPE * stride, WIDTH, base, WIDTH, 1);
  sums.add(at + HIDDEN * stride, WIDTH + 1, at + D_OUT * stride, OUTPUTS,
           base + (INPUTS + 1) * WIDTH, OUTPUTS, 1);
  if (!with_view) return;
  sums.add(at + (OUT + 4) * stride, BOTTLENECK + 10, at + VIEW_SLOPE * stride, VIEW, view, VIEW, 1);
  sums.add(at + D_COLOR * stride, 3, at + VIEW_HIDDEN * stride, VIEW + 1,
           view + (BOTTLENECK + 10) * VIEW, 1, 3);
"""
)
