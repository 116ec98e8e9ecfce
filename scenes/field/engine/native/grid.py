"""Samples, hash grid, compositing and optimiser of the trainer as C++ snippets, see `native`."""

# A number in [0, 1) that depends on nothing but its arguments (splitmix64).
UNIFORM = r"""
  unsigned long long z = seed + (unsigned long long)index * 0x9E3779B97F4A7C15ull
                         + (unsigned long long)dimension * 0xD1B54A32D192ED03ull;
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
  z = z ^ (z >> 31);
  return (float)(unsigned)(z >> 40) * (1.0f / 16777216.0f);
"""

SQUASH = r"""
  float squash = Math::squash(norm);
  return wp::vec3(Math::grid(p[0], squash), Math::grid(p[1], squash), Math::grid(p[2], squash));
"""

SQUAREPLUS = "  return Math::squareplus(z);\n"

# Grid coordinates and variance inputs of the samples, from their rays' rows.
PLACE = r"""
  float* w = worker.work.data;
  for (int n = begin; n < end; n += LANES) {
    Vec ray[7];  // origin, direction, footprint
    const int rows[7] = {0, 1, 2, 3, 4, 5, 9};
    UNROLL for (int i = 0; i < 7; ++i)
      UNROLL for (int k = 0; k < LANES; ++k)
        LANE(ray[i], k) = worker.rays.data[rows[i] * RAYS + worker.ray_of.data[n + k]];
    Vec t = Math::load(w + DISTANCE * stride + n);
    Vec p[3];
    UNROLL for (int i = 0; i < 3; ++i) p[i] = ray[i] + t * ray[3 + i];
    Vec norm = Math::greater(Math::magnitude(p[0]), Math::magnitude(p[1]));
    norm = Math::greater(Math::greater(norm, Math::magnitude(p[2])), Math::same(1.0f));
    Vec squash = Math::squash(norm);
    Vec spread = settings.pixel_angle * t;
    Vec across = ray[6] * spread * spread * (1.0f / 12.0f);
    Vec length = settings.variance_step * norm;
    Vec along = length * length * (1.0f / 12.0f);
    UNROLL for (int i = 0; i < 3; ++i) {
      Math::store(w + (PLACE_U + i) * stride + n, Math::grid(p[i], squash));
      Vec d = ray[3 + i] * ray[3 + i];
      Vec variance = across * (1.0f - d) + along * d;
      Math::store(w + (INPUT + 2 * LEVELS + i) * stride + n, Math::extent(variance));
    }
  }
"""

# Rows of a cell's 8 corners, x fastest; shared by ENCODE and SCATTER.
_CORNERS = r"""
  struct Cell {
    Vec f[3];
    Int row[8];
    // Coordinates in [0, 1]; rows: the level's column of encoding.level_rows.
    INLINE Cell find(const float* place, int stride, const int* rows) {
      Cell c;
      int cells = rows[3 * LEVELS];
      int stride_y = rows[0], stride_z = rows[LEVELS], mask = rows[2 * LEVELS];
      Int x = Math::lower(Math::load(place), cells, c.f[0]);
      Int y = Math::lower(Math::load(place + stride), cells, c.f[1]) * stride_y;
      Int z = Math::lower(Math::load(place + 2 * stride), cells, c.f[2]) * stride_z;
      UNROLL for (int k = 0; k < 8; ++k)
        c.row[k] = Math::entry(x + (k & 1), y + ((k & 2) ? stride_y : 0),
                               z + ((k & 4) ? stride_z : 0), mask);
      return c;
    }
    // Fetches the cache lines of the rows of pairs ahead of their use. Corners that differ along
    // x mostly share one.
    void fetch(const float* pairs) const {
#if !defined(__CUDACC__)
      UNROLL for (int k = 0; k < 8; k += 2)
        UNROLL for (int l = 0; l < LANES; ++l) __builtin_prefetch(pairs + 2 * row[k][l], 1);
#endif
    }
    INLINE void weights(const Cell& c, Vec (&w)[8]) {
      Vec gx = 1.0f - c.f[0], gy = 1.0f - c.f[1], gz = 1.0f - c.f[2];
      Vec side[4] = {gy * gz, c.f[1] * gz, gy * c.f[2], c.f[1] * c.f[2]};
      UNROLL for (int k = 0; k < 4; ++k) {
        w[2 * k] = gx * side[k];
        w[2 * k + 1] = c.f[0] * side[k];
      }
    }
  };
"""

# Features of the hash grid.
ENCODE = (
  _CORNERS
  + r"""
  float* w = worker.work.data;
  for (int level = 0; level < LEVELS; ++level) {
    const unsigned long long* pairs =
        (const unsigned long long*)model.table.data + (long long)level * model.entries;
    for (int n = begin; n < end; n += LANES) {
      Cell cell = Cell::find(w + PLACE_U * stride + n, stride, model.levels.data + level);
      Vec weight[8];
      Cell::weights(cell, weight);
      Vec first = Math::same(0.0f), second = Math::same(0.0f);
      UNROLL for (int k = 0; k < 8; ++k) {
        alignas(64) int row[LANES];
        alignas(64) unsigned long long pair[LANES];
        *(Int*)row = cell.row[k];
        for (int l = 0; l < LANES; ++l) pair[l] = pairs[row[l]];
        Int low, high;
        UNROLL for (int l = 0; l < LANES; ++l) {
          LANE(low, l) = (int)pair[l];
          LANE(high, l) = (int)(pair[l] >> 32);
        }
        first += weight[k] * Math::as_float(low);
        second += weight[k] * Math::as_float(high);
      }
      Math::store(w + (INPUT + 2 * level) * stride + n, first);
      Math::store(w + (INPUT + 2 * level + 1) * stride + n, second);
    }
  }
"""
)

# Outputs -> opacities of the intervals.
OPACITY = r"""
  float* w = worker.work.data;
  for (int n = begin; n < end; n += LANES) {
    Vec density = settings.density_scale
        * Math::squareplus(settings.density_gain * Math::load(w + OUT * stride + n)
                           + settings.density_bias);
    Vec alpha = 1.0f - Math::exponential(-density * Math::load(w + LENGTH * stride + n));
    Math::store(w + ALPHA * stride + n, alpha);
  }
"""

# Drops the samples of every ray behind opaque matter; returns how many are left. A ray whose march
# the depth limit ended before opaque matter has none: its number comes behind those that wait.
KEEP_VISIBLE = r"""
  float* w = worker.work.data;
  int* first = worker.first.data;
  int from[RAYS], length[RAYS];
  int kept = 0, moved = rays;  // rays before `moved` stay where they are
  for (int r = 0; r < rays; ++r) {
    int start = first[r], stop = first[r + 1], begin = kept;
    float through = 1.0f;
    for (int n = start; n < stop; ++n) {
      float alpha = w[ALPHA * stride + n];
      w[WEIGHT * stride + kept] = through * alpha;
      through *= 1.0f - alpha;
      w[THROUGH * stride + kept] = through;
      ++kept;
      if (through < threshold) break;
    }
    if (worker.number.data[r] < 0 && through >= threshold) {
      worker.again.data[waiting++] = ~worker.number.data[r];
      kept = begin;
    }
    first[r] = begin;
    from[r] = start;
    length[r] = kept - begin;
    if (start != begin && moved == rays) moved = r;
  }
  first[rays] = kept;
  if (moved == rays) return kept;
  const int spans[][2] = {{DISTANCE, 2}, {PLACE_U, 3}, {GAIN, 1}, {INPUT, INPUTS},
                          {HIDDEN, WIDTH}, {SLOPE, WIDTH}, {OUT, OUTPUTS}};
  alignas(64) float packed[CAPACITY + LANES];
  int base = first[moved];
  for (int s = 0; s < 7; ++s) {
    for (int i = 0; i < spans[s][1]; ++i) {
      float* row = w + (spans[s][0] + i) * stride;
      // Whole vectors are copied; what is too much the next ray's samples overwrite.
      for (int r = moved; r < rays; ++r)
        for (int n = 0; n < length[r]; n += LANES)
          Math::store(packed + first[r] - base + n, Math::load(row + from[r] + n));
      for (int n = 0; n < kept - base; n += LANES)
        Math::store(row + base + n, Math::load(packed + n));
    }
  }
  for (int r = moved; r < rays; ++r)
    for (int n = first[r]; n < first[r] + length[r]; ++n) worker.ray_of.data[n] = r;
  return kept;
"""

# Adds one level's part of the table's gradient.
SCATTER = (
  _CORNERS
  + r"""
  float* rows = gradient.data + (long long)level * model.entries * 2;
  const float* w = worker.kept.data;
  for (int n = begin; n < end; n += LANES) {
    Cell cell = Cell::find(w + n, worker.kept_stride, model.levels.data + level);
    Vec weight[8];
    Cell::weights(cell, weight);
    Vec d0 = Math::load(w + (3 + 2 * level) * worker.kept_stride + n);
    Vec d1 = Math::load(w + (4 + 2 * level) * worker.kept_stride + n);
#if defined(__CUDACC__)
    if (d0 == 0.0f && d1 == 0.0f) continue;
    UNROLL for (int k = 0; k < 8; ++k) {
      ADD(rows[2 * cell.row[k]], weight[k] * d0);
      ADD(rows[2 * cell.row[k] + 1], weight[k] * d1);
    }
#else
    typedef float Pair __attribute__((ext_vector_type(2)));
    alignas(64) int row[8][LANES];
    alignas(64) float first[8][LANES], second[8][LANES];
    UNROLL for (int k = 0; k < 8; ++k) {
      *(Int*)row[k] = cell.row[k];
      *(Vec*)first[k] = weight[k] * d0;
      *(Vec*)second[k] = weight[k] * d1;
    }
    // The next samples' entries come from memory meanwhile: half of the time otherwise.
    Cell::find(w + n + LANES, worker.kept_stride, model.levels.data + level).fetch(rows);
    int last = end - n < LANES ? end - n : LANES;
    for (int l = 0; l < last; ++l)
      UNROLL for (int k = 0; k < 8; ++k)
        ((Pair*)rows)[row[k][l]] += (Pair){first[k][l], second[k][l]};
#endif
  }
"""
)

# AdamW on values [begin, end) where the gradient is not zero; clears the gradient.
ADAM = r"""
  for (int i = begin; i < end; i += LANES) {
    float* slope = optimised.gradient.data + i;
    Vec g = Math::load(slope);
    if (Math::total(Math::magnitude(g)) == 0.0f) continue;
    auto live = g != 0.0f;
    Vec m = Math::load(optimised.first.data + i), v = Math::load(optimised.second.data + i);
    Vec value = Math::load(optimised.values.data + i);
    Vec m2 = how.beta1 * m + (1.0f - how.beta1) * g;
    Vec v2 = how.beta2 * v + (1.0f - how.beta2) * g * g;
    Vec moved = value * how.keep - how.rate * how.correction1 * m2
                / (Math::root(v2 * how.correction2) + how.epsilon);
    Math::store(optimised.first.data + i, live ? m2 : m);
    Math::store(optimised.second.data + i, live ? v2 : v);
    Math::store(optimised.values.data + i, live ? moved : value);
    Math::store(slope, Math::same(0.0f));
  }
"""

# One axis of the Chebyshev distance: result = min_j max(|j|, source j cells on), for a row along z.
DISTANCE_ROW = r"""
  const int MOST = 1024;  // cells along an axis
  const unsigned char* from = source.data;
  unsigned char padded[MOST + 512];
  unsigned char best[MOST];
  int x = row / size, y = row % size;
  if (axis == 2)
    for (int z = 0; z < size + 2 * limit; ++z)
      padded[z] = z >= limit && z < size + limit ? from[row * size + z - limit] : limit;
  for (int z = 0; z < size; ++z) best[z] = limit;
  for (int j = 1 - limit; j < limit; ++j) {
    const unsigned char* line = padded + limit + j;
    if (axis < 2) {
      int moved = (axis == 0 ? x : y) + j;
      if (moved < 0 || moved >= size) continue;
      line = from + (row + j * (axis == 0 ? size : 1)) * size;
    }
    unsigned char least = j < 0 ? -j : j;
    for (int z = 0; z < size; ++z) {
      unsigned char far = line[z] > least ? line[z] : least;
      best[z] = far < best[z] ? far : best[z];
    }
  }
  for (int z = 0; z < size; ++z) result.data[row * size + z] = best[z];
"""
