"""Exponential and logarithm of float32 without calls, so that numba loops over them vectorise."""

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_LIMIT = 87.0  # exp(+-87) is the edge of the normal float32
_EXP_TERMS = 6  # 2^f on [-0.5, 0.5] by Taylor: relative error 2e-6 at the ends
_LOG_TERMS = 5  # log2 by its series in (m - 1) / (m + 1), m in [1, 2): absolute error 2e-6


def _constant(value: float) -> ir.Constant:
  return ir.Constant(_FLOAT, float(np.float32(value)))


def _integer(value: int) -> ir.Constant:
  return ir.Constant(_INT, value)


def _polynomial(builder, x, coefficients):
  """Horner's rule; coefficients[0] is the constant term."""
  total = _constant(coefficients[-1])
  for coefficient in coefficients[-2::-1]:
    total = builder.fmul(total, x, flags=["fast"])
    total = builder.fadd(total, _constant(coefficient), flags=["fast"])
  return total


@intrinsic
def fast_exp(typing_context, x):
  """exp(x) of a float32, clamped to exp(+-87)."""

  def codegen(context, builder, signature, arguments):
    (x,) = arguments
    for limit, relation in ((-_LIMIT, "<"), (_LIMIT, ">")):
      beyond = builder.fcmp_ordered(relation, x, _constant(limit), flags=["fast"])
      x = builder.select(beyond, _constant(limit), x)
    z = builder.fmul(x, _constant(1 / np.log(2)), flags=["fast"])
    shifted = builder.fptosi(builder.fadd(z, _constant(256.5), flags=["fast"]), _INT)
    whole = builder.sub(shifted, _integer(256))
    rest = builder.fsub(z, builder.sitofp(whole, _FLOAT), flags=["fast"])
    terms, term = [1.0], 1.0
    for k in range(1, _EXP_TERMS + 1):
      term *= np.log(2) / k
      terms.append(term)
    power = _polynomial(builder, rest, terms)
    exponent = builder.shl(builder.add(whole, _integer(127)), _integer(23))
    return builder.fmul(power, builder.bitcast(exponent, _FLOAT), flags=["fast"])

  return types.float32(types.float32), codegen


@intrinsic
def fast_log2(typing_context, x):
  """Binary logarithm of a positive normal float32."""

  def codegen(context, builder, signature, arguments):
    bits = builder.bitcast(arguments[0], _INT)
    exponent = builder.sub(builder.lshr(bits, _integer(23)), _integer(127))
    mantissa = builder.or_(builder.and_(bits, _integer(0x7FFFFF)), _integer(0x3F800000))
    m = builder.bitcast(mantissa, _FLOAT)
    s = builder.fdiv(
      builder.fsub(m, _constant(1), flags=["fast"]), builder.fadd(m, _constant(1), flags=["fast"])
    )
    terms = [2 / np.log(2) / (2 * k + 1) for k in range(_LOG_TERMS)]
    series = _polynomial(builder, builder.fmul(s, s, flags=["fast"]), terms)
    logarithm = builder.fmul(s, series, flags=["fast"])
    return builder.fadd(builder.sitofp(exponent, _FLOAT), logarithm, flags=["fast"])

  return types.float32(types.float32), codegen


@numba.njit(fastmath=True, nogil=True, error_model="numpy", inline="always")
def sigmoid(x):
  """1 / (1 + exp(-x)) of a float32."""
  return np.float32(1) / (np.float32(1) + fast_exp(-x))
