"""Equations of motion of the links: a chain in a plane, a pan-tilt head, a jaw on a rail.

Lagrange's equations: a chain in the absolute angles of its links, a head in moments of its mass.
Angles of chains are from hanging straight. Shapes: n joints.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

Array = np.ndarray
GRAVITY = 9.81  # m/s^2, as MuJoCo has it
CHAIN, HEAD, RAIL = range(3)
JOINTS = {
  "single": ("joint",),
  "head": ("pan", "tilt"),
  "leg": ("hip", "knee", "ankle"),
  "finger": ("jaw",),
}
"""Names by plant."""
FORMS = {"single": CHAIN, "head": HEAD, "leg": CHAIN, "finger": RAIL}
_MOST = 3  # joints


class Links(NamedTuple):
  """What moves, each link in the frame of its joint; chains hang along -z, jaws slide along x."""

  mass: Array  # [n] kg
  centre: Array  # [n, 3] m
  inertia: Array  # [n, 3] kg m^2, about the centre along x, y, z
  length: Array  # [n] m, to the next joint: along -z of a chain, along x of a head
  load: Array  # [n] kg, a point mass that is not declared
  place: Array  # [n, 3] m, of that


class Body(NamedTuple):
  """Coefficients of the equations of motion."""

  form: int
  inertia: Array  # [n, n]
  moment: Array  # [n] of a chain, [10] of a head
  gravity: Array  # [3] m/s^2 in the base's frame


def body_of(plant: str, links: Links, turn: Array, gravity: Array) -> Body:
  """Returns the coefficients.

  Args:
    plant: of JOINTS.
    links: what moves.
    turn: [3, 3] from the base's frame to the world's.
    gravity: [3] m/s^2 in the world.
  """
  form, pull = FORMS[plant], np.ascontiguousarray(turn.T @ gravity)
  total, n = links.mass + links.load, len(links.mass)
  inertia = np.zeros((n, n))
  if form == RAIL:
    inertia[0, 0] = total[0]
    return Body(form, inertia, total.copy(), pull)
  if form == HEAD:
    inertia[0, 0] = links.inertia[0, 2]
    first = links.mass[1] * links.centre[1] + links.load[1] * links.place[1]
    # The integral of x x^T over the mass, of which the inertia is the trace less itself.
    second = np.diag(0.5 * links.inertia[1].sum() - links.inertia[1])
    second += links.mass[1] * np.outer(links.centre[1], links.centre[1])
    second += links.load[1] * np.outer(links.place[1], links.place[1])
    x, y, z = second
    parts = (total[1], links.length[0], *first, x[0], z[2], y[1], x[1], x[2], y[2])
    return Body(form, inertia, np.array(parts), pull)
  first = -links.mass * links.centre[:, 2] - links.load * links.place[:, 2]
  second = links.inertia[:, 1] + links.mass * links.centre[:, 2] ** 2
  second = second + links.load * links.place[:, 2] ** 2
  beyond = total[::-1].cumsum()[::-1] - total
  moment = first + links.length * beyond
  for i in range(n):
    inertia[i, i] = second[i] + links.length[i] ** 2 * beyond[i]
    inertia[i, i + 1 :] = inertia[i + 1 :, i] = links.length[i] * moment[i + 1 :]
  return Body(form, inertia, moment, pull)


@numba.njit(cache=True)
def _solve(matrix: Array, right: Array, n: int) -> None:
  """Solves matrix x = right in place, which is positive definite: Gauss without pivots."""
  for i in range(n):
    for k in range(i + 1, n):
      factor = matrix[k, i] / matrix[i, i]
      right[k] -= factor * right[i]
      for j in range(i, n):
        matrix[k, j] -= factor * matrix[i, j]
  for i in range(n - 1, -1, -1):
    for j in range(i + 1, n):
      right[i] -= matrix[i, j] * right[j]
    right[i] /= matrix[i, i]


@numba.njit(cache=True)
def accelerate(body: Body, q: Array, v: Array, torque: Array, out: Array) -> None:
  """Writes the accelerations of the joints under torques [n] N m or N."""
  n, pull, moment = q.size, body.gravity, body.moment
  if body.form == RAIL:
    out[0] = torque[0] / body.inertia[0, 0] + pull[0]
    return
  mass = np.empty((_MOST, _MOST))
  if body.form == CHAIN:
    angle, rate = np.empty(_MOST), np.empty(_MOST)
    for i in range(n):
      angle[i] = q[i] + (angle[i - 1] if i else 0.0)
      rate[i] = v[i] + (rate[i - 1] if i else 0.0)
    for i in range(n):
      out[i] = torque[i] - (torque[i + 1] if i + 1 < n else 0.0)
      out[i] += moment[i] * (pull[2] * math.sin(angle[i]) - pull[0] * math.cos(angle[i]))
      mass[i, i] = body.inertia[i, i]
      for j in range(n):
        if j != i:
          mass[i, j] = body.inertia[i, j] * math.cos(angle[i] - angle[j])
          out[i] -= body.inertia[i, j] * math.sin(angle[i] - angle[j]) * rate[j] ** 2
    _solve(mass, out, n)
    for i in range(n - 1, 0, -1):
      out[i] -= out[i - 1]
    return
  m, o, fx, fy, fz, pxx, pzz, pyy, pxy, pxz, pyz = moment
  s, c = math.sin(q[1]), math.cos(q[1])
  x, z = fx * c + fz * s, fz * c - fx * s  # first moment in the frame of the pan
  xx = pxx * c * c + 2.0 * pxz * c * s + pzz * s * s
  xz = (pzz - pxx) * c * s + pxz * (c * c - s * s)
  xy, yz = pxy * c + pyz * s, pyz * c - pxy * s
  mass[0, 0] = body.inertia[0, 0] + m * o * o + 2.0 * o * x + xx + pyy
  mass[0, 1] = mass[1, 0] = -yz
  mass[1, 1] = pxx + pzz
  change = 2.0 * (o * z + xz)  # of the first by the tilt
  sp, cp = math.sin(q[0]), math.cos(q[0])
  ahead, aside = pull[0] * cp + pull[1] * sp, pull[1] * cp - pull[0] * sp
  out[0] = torque[0] - change * v[0] * v[1] - xy * v[1] ** 2
  out[0] += aside * (m * o + x) - ahead * fy
  out[1] = torque[1] + 0.5 * change * v[0] ** 2 + ahead * z - pull[2] * x
  _solve(mass, out, n)
