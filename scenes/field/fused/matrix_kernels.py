"""Small matrix products for numba kernels, with the accumulators held in vector registers.

numba leaves sums over an inner index in memory, which costs a factor of five in products as small
as the field's layers. Here the inner tile is written as LLVM instructions on 16-lane vectors: a
tile of rows x 16 columns stays in registers over the whole sum. LLVM maps 16 lanes to whatever
the machine has (AVX-512, AVX2, NEON).
"""

from collections.abc import Callable

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16  # float32 numbers in a vector


def _make_tile(rows: int, vectors: int) -> Callable:
  """Builds y[r, :] += sum_c x[r, c] w[c, :] for `rows` rows and 16 `vectors` columns."""

  @intrinsic
  def tile(typing_context, x, x_at, x_row, x_column, w, w_at, w_row, y, y_at, y_row, count):
    index = types.int64
    signature = types.void(x, index, index, index, w, index, index, y, index, index, index)

    def codegen(context, builder, signature, arguments):
      float32, int64 = ir.FloatType(), ir.IntType(64)
      vector = ir.VectorType(float32, LANES)
      (x, x_at, x_row, x_column, w, w_at, w_row, y, y_at, y_row, count) = arguments

      def pointer(kind, array, offset):
        data = context.make_array(kind)(context, builder, array).data
        return builder.gep(data, [offset])

      def as_vector(address):
        return builder.bitcast(address, vector.as_pointer())

      def constant(value):
        return ir.Constant(int64, value)

      x_base = pointer(signature.args[0], x, x_at)
      w_base = pointer(signature.args[4], w, w_at)
      y_base = pointer(signature.args[7], y, y_at)
      x_starts = [builder.gep(x_base, [builder.mul(constant(row), x_row)]) for row in range(rows)]
      y_starts = []
      for row in range(rows):
        start = builder.gep(y_base, [builder.mul(constant(row), y_row)])
        y_starts.append(
          [as_vector(builder.gep(start, [constant(LANES * v)])) for v in range(vectors)]
        )
      first = [[builder.load(address, align=4) for address in line] for line in y_starts]
      before = builder.block
      body = builder.append_basic_block("tile.body")
      after = builder.append_basic_block("tile.after")
      builder.cbranch(builder.icmp_signed(">", count, constant(0)), body, after)

      builder.position_at_end(body)
      step = builder.phi(int64)
      step.add_incoming(constant(0), before)
      sums = [[builder.phi(vector) for _ in range(vectors)] for _ in range(rows)]
      w_start = builder.gep(w_base, [builder.mul(step, w_row)])
      weights = [
        builder.load(as_vector(builder.gep(w_start, [constant(LANES * v)])), align=4)
        for v in range(vectors)
      ]
      fma = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32"
      )
      x_offset = builder.mul(step, x_column)
      zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
      updated = []
      for row in range(rows):
        scalar = builder.load(builder.gep(x_starts[row], [x_offset]), align=4)
        single = builder.insert_element(
          ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0)
        )
        splat = builder.shuffle_vector(single, ir.Constant(vector, ir.Undefined), zeros)
        updated.append(
          [builder.call(fma, [splat, weights[v], sums[row][v]]) for v in range(vectors)]
        )
      following = builder.add(step, constant(1))
      builder.cbranch(builder.icmp_signed("<", following, count), body, after)
      step.add_incoming(following, body)
      for row in range(rows):
        for v in range(vectors):
          sums[row][v].add_incoming(first[row][v], before)
          sums[row][v].add_incoming(updated[row][v], body)

      builder.position_at_end(after)
      for row in range(rows):
        for v in range(vectors):
          result = builder.phi(vector)
          result.add_incoming(first[row][v], before)
          result.add_incoming(updated[row][v], body)
          y_starts[row][v] = (y_starts[row][v], result)
      for row in range(rows):
        for address, result in y_starts[row]:
          builder.store(result, address, align=4)
      return context.get_dummy_value()

    return signature, codegen

  return tile


_tile_6x4, _tile_1x4 = _make_tile(6, 4), _make_tile(1, 4)
_tile_7x2, _tile_1x2 = _make_tile(7, 2), _make_tile(1, 2)
_tile_8x1, _tile_1x1 = _make_tile(8, 1), _make_tile(1, 1)


@numba.njit(fastmath=True, nogil=True, error_model="numpy")
def add_product(x, x_at, x_row, x_column, w, w_at, w_row, y, y_at, y_row, rows, count, columns):
  """Adds a matrix product: y[r, j] += sum_c x[r, c] w[c, j].

  All arrays are flat float32; `_at` is the offset of the first element, `_row` and `_column` are
  strides. With x_row and x_column exchanged the same routine multiplies by the transpose.

  Args:
    x, x_at, x_row, x_column: Left matrix [rows, count].
    w, w_at, w_row: Right matrix [count, columns], contiguous along columns.
    y, y_at, y_row: Result [rows, columns], contiguous along columns.
    rows, count, columns: Sizes; columns is a multiple of 16.
  """
  done = 0
  while columns - done >= 64:
    r = 0
    while r + 6 <= rows:
      _tile_6x4(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 6
    while r < rows:
      _tile_1x4(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 1
    done += 64
  while columns - done >= 32:
    r = 0
    while r + 7 <= rows:
      _tile_7x2(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 7
    while r < rows:
      _tile_1x2(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 1
    done += 32
  while columns - done >= 16:
    r = 0
    while r + 8 <= rows:
      _tile_8x1(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 8
    while r < rows:
      _tile_1x1(
        x,
        x_at + r * x_row,
        x_row,
        x_column,
        w,
        w_at + done,
        w_row,
        y,
        y_at + r * y_row + done,
        y_row,
        count,
      )
      r += 1
    done += 16
