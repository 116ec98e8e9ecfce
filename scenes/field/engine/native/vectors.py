"""C++ for Warp's native functions: vectors of samples, and the field's formulas written once.

A vector `Vec` holds the same quantity of LANES samples: CPU_LANES in the trainer on a CPU (clang's
vector extension maps them to what the machine has), one on CUDA, where a lane is a thread, and one
in the renderer, whose loops run over levels and neurons of a single sample. All that belongs to a
sample of the trainer lies in a work array of rows, `work[row * stride + sample]`; weights are read
as scalars and broadcast. A snippet is the body of one function that Warp compiles for both.
"""

# Samples of a vector on a CPU: 512 bits of float32. Any CPU of clang's runs them, narrower
# ones in several registers; 8 is the better choice for a machine without AVX-512.
CPU_LANES = 16
PADDING = 32  # samples that a product's inner loop works on at a time: LANES * VECS on a CPU

_PRELUDE = r"""
#undef SCALAR
#undef TO_FLOAT
#undef TO_INT
#undef LANE
#undef UNROLL
#undef VECTORISE
#undef ADD
#undef INLINE
#if defined(__CUDACC__)
  #define SCALAR 1
  #define ADD(place, value) atomicAdd(&(place), value)
  #define UNROLL _Pragma("unroll")
  #define VECTORISE _Pragma("unroll")
  constexpr int LANES = 1, VECS = 1;
#else
  #define SCALAR $SCALAR
  #define ADD(place, value) (place) += (value)
  #define UNROLL _Pragma("clang loop unroll(full)")
  #define VECTORISE _Pragma("clang loop vectorize(enable)")
  constexpr int LANES = $LANES, VECS = $VECS;
#endif
#if SCALAR
  typedef float Vec;
  typedef float Loose;
  typedef int Int;
  #define TO_FLOAT(x) ((float)(x))
  #define TO_INT(x) ((int)(x))
  #define LANE(x, k) (x)
#else
  typedef float Vec __attribute__((ext_vector_type($LANES)));
  typedef float Loose __attribute__((ext_vector_type($LANES), aligned(4)));
  typedef int Int __attribute__((ext_vector_type($LANES)));
  #define TO_FLOAT(x) __builtin_convertvector(x, Vec)
  #define TO_INT(x) __builtin_convertvector(x, Int)
  #define LANE(x, k) (x)[k]
#endif
#define INLINE static inline __attribute__((always_inline))
  constexpr int BLOCK = LANES * VECS;  // samples that a matrix product's inner loop works on
  constexpr int TILE = 8;  // rows of its result: TILE * VECS vectors stay in registers
  struct Math {
    INLINE Vec load(const float* p) { return *(const Loose*)p; }
    INLINE void store(float* p, Vec v) { *(Loose*)p = v; }
    INLINE Vec same(float x) { return (Vec)(x); }
    INLINE Vec lesser(Vec a, Vec b) { return a < b ? a : b; }
    INLINE Vec greater(Vec a, Vec b) { return a > b ? a : b; }
    INLINE Vec magnitude(Vec a) { return greater(a, -a); }
    INLINE Vec as_float(Int i) { union { Int i; Vec f; } u; u.i = i; return u.f; }
    INLINE Int as_int(Vec f) { union { Int i; Vec f; } u; u.f = f; return u.i; }
    INLINE Vec root(Vec x) {
#if SCALAR
      return sqrtf(x);
#else
      return __builtin_elementwise_sqrt(x);
#endif
    }
    // 1 / x of a positive normal x: a guess from the bits and three steps of Newton's, as a
    // division of vectors takes three times as long (relative error 1e-7).
    INLINE Vec inverse(Vec x) {
#if SCALAR
      return 1.0f / x;
#else
      Vec y = as_float(0x7ef311c7 - as_int(x));
      y = y * (2.0f - x * y);
      y = y * (2.0f - x * y);
      return y * (2.0f - x * y);
#endif
    }
    // e^x, clamped to 2^+-125, by range reduction and a polynomial: relative error 3e-7.
    INLINE Vec exponential(Vec x) {
      Vec y = lesser(greater(x * 1.44269504f, same(-125.5f)), same(125.5f));
      Vec shifted = y + 12582912.0f;  // 1.5 * 2^23: rounds, and leaves the integer in the low bits
      Vec part = y - (shifted - 12582912.0f);
      Vec power = 1.0f + part * (0.69314718f + part * (0.24022651f + part * (0.05550411f
                  + part * (0.00961813f + part * (0.00133336f + part * 0.00015404f)))));
      return as_float(as_int(power) + (as_int(shifted) << 23));
    }
    INLINE Vec sigmoid(Vec x) { return inverse(1.0f + exponential(-x)); }
    // Binary logarithm of a positive normal number by its series in (m - 1) / (m + 1): 2e-6.
    INLINE Vec logarithm(Vec x) {
      Int bits = as_int(x);
      Vec power = TO_FLOAT((bits >> 23) - 127);
      Vec m = as_float((bits & 0x7fffff) | 0x3f800000);
      Vec s = (m - 1.0f) * inverse(m + 1.0f), q = s * s;
      return power + s * (2.8853901f + q * (0.9617967f + q * (0.5770780f + q * (0.4121986f
             + q * 0.3205989f))));
    }
    INLINE float total(Vec x) {
#if SCALAR
      return x;
#else
      float sum = 0.0f;
      UNROLL for (int k = 0; k < LANES; ++k) sum += x[k];
      return sum;
#endif
    }
    // sums[t] += sum_i weight[i * inner + t * outer] * x[i]
    INLINE void product(Vec (&sums)[TILE][VECS], const float* x, int stride, int count,
                        const float* weight, int inner, int outer) {
      for (int i = 0; i < count; ++i) {
        Vec value[VECS];
        UNROLL for (int v = 0; v < VECS; ++v) value[v] = load(x + i * stride + v * LANES);
        UNROLL for (int t = 0; t < TILE; ++t) {
          Vec w = same(weight[i * inner + t * outer]);
          UNROLL for (int v = 0; v < VECS; ++v) sums[t][v] += w * value[v];
        }
      }
    }

    // (x + sqrt(x^2 + 4)) / 2 without cancellation for very negative inputs, see field.squareplus.
    INLINE Vec squareplus(Vec x) {
      Vec r = root(x * x + 4.0f);
      return x > 0.0f ? 0.5f * (x + r) : 2.0f / (r - x);
    }
    // Factor of contraction.grid_coordinates: [0, 1] from a point with max(1, |x|_max) = norm.
    INLINE Vec squash(Vec norm) {
      Vec i = inverse(norm);
      return (2.0f - i) * i * 0.25f;
    }
    INLINE Vec grid(Vec x, Vec squash) {
      return lesser(greater(x * squash + 0.5f, same(0.0f)), same(0.9999999f));
    }
    // Input of the network from a variance [unit^2], see encoding.variance_features.
    INLINE Vec extent(Vec variance) { return 0.05f * logarithm(variance + 1e-10f) + 1.0f; }
    // See encoding.spherical_harmonics.
    INLINE void harmonics(Vec x, Vec y, Vec z, Vec (&h)[9]) {
      h[0] = same(0.28209479f);
      h[1] = -0.48860251f * y;
      h[2] = 0.48860251f * z;
      h[3] = -0.48860251f * x;
      h[4] = 1.09254843f * x * y;
      h[5] = -1.09254843f * y * z;
      h[6] = 0.31539157f * (3.0f * z * z - 1.0f);
      h[7] = -1.09254843f * x * z;
      h[8] = 0.54627421f * (x * x - y * y);
    }
    // Lower vertex of the grid cell around a coordinate in [0, 1], and the place within the cell.
    INLINE Int lower(Vec coordinate, int cells, Vec& fraction) {
      Vec p = coordinate * (float)cells;
      Int at = TO_INT(p);
      at = at < cells - 1 ? at : (Int)(cells - 1);
      fraction = p - TO_FLOAT(at);
      return at;
    }
    // Row of a vertex in its level's table; y and z times the level's strides, see
    // encoding.level_rows. Mueller et al. 2022, equation 4, where the level is not dense.
    INLINE Int entry(Int x, Int y, Int z, int mask) {
      return mask ? (x ^ y ^ z) & mask : x + y + z;
    }
  };
"""


def snippet(body: str, *, lanes: int = CPU_LANES, **constants: int | float) -> str:
  """Returns a function body with what it reads in front.

  Args:
    body: C++.
    lanes: Samples of a `Vec` on a CPU.
    constants: Numbers that are compiled in, by name.
  """
  lines = [
    f"constexpr int {name} = {value};"
    if isinstance(value, int)
    else f"constexpr float {name} = {value!r}f;"
    for name, value in constants.items()
  ]
  prelude = _PRELUDE.replace("$SCALAR", str(int(lanes == 1))).replace("$LANES", str(lanes))
  prelude = prelude.replace("$VECS", str(max(PADDING // lanes, 1) if lanes > 1 else 1))
  return "\n".join(lines) + prelude + body
