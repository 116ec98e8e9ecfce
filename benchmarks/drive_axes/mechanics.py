"""Links: a carriage on a vertical slide, a level arm, a planar arm of two joints in the vertical.

Planar equations of motion by Lagrange (as in Spong, Hutchinson, Vidyasagar 2006, section 7.5.2),
with q the relative angles, c and s the cosine and sine of q_2:
  M = [[a1 + 2 a2 c, a3 + a2 c], [a3 + a2 c, a3]]
  bias = [-a2 s (2 v1 v2 + v2^2), a2 s v1^2]
  gravity = [m1 f(q1) + m2 f(q1 + q2), m2 f(q1 + q2)],  f(q) = along cos q + across sin q.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

GRAVITY = 9.81
"""m/s^2, MuJoCo's."""


class Links(NamedTuple):
  """What moves, one entry a joint [n]."""

  mass: np.ndarray  # kg
  centre: np.ndarray  # m, of mass, from the joint along the link
  inertia: np.ndarray  # kg m^2, about the centre and the joint's axis
  length: np.ndarray  # m, to the next joint
  load: np.ndarray  # kg, a point on the link
  reach: np.ndarray  # m, from the joint to that point
  tilt: np.ndarray  # rad [2], of gravity, about the world's x and y


class Coefficients(NamedTuple):
  """Those of the equations above; `constant` is a slide's weight, N."""

  a1: float
  a2: float
  a3: float
  m1: float
  m2: float
  along: float
  across: float
  constant: float


def coefficients(plant: str, links: Links) -> Coefficients:
  """Returns the equations' coefficients for a plant's links."""
  x, y = links.tilt
  angle = math.hypot(x, y)
  sinc = math.sin(angle) / angle if angle else 1.0
  gravity = GRAVITY * np.array([-y * sinc, x * sinc, -math.cos(angle)])
  mass = links.mass + links.load
  moment = links.mass * links.centre + links.load * links.reach
  about = links.inertia + links.mass * links.centre**2 + links.load * links.reach**2
  if plant == "lift":
    return Coefficients(float(mass[0]), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, float(mass[0] * gravity[2]))
  if plant == "swing":  # at (cos q, sin q, 0)
    along, across = gravity[1], -gravity[0]
    return Coefficients(float(about[0]), 0.0, 0.0, float(moment[0]), 0.0, along, across, 0.0)
  along, across = -gravity[0], gravity[2]  # at (-sin q, 0, -cos q)
  first = links.length[0]
  return Coefficients(
    float(about[0] + about[1] + mass[1] * first**2),
    float(first * moment[1]),
    float(about[1]),
    float(moment[0] + mass[1] * first),
    float(moment[1]),
    along,
    across,
    0.0,
  )


@numba.njit(cache=True)
def accelerate(
  of: Coefficients, q: np.ndarray, v: np.ndarray, torque: np.ndarray, out: np.ndarray
) -> None:
  """Writes accelerations [n] of links under torques [n] at their joints into `out`."""
  pull = of.along * math.cos(q[0]) + of.across * math.sin(q[0])
  first = torque[0] + of.m1 * pull + of.constant
  if q.size == 1:
    out[0] = first / of.a1
    return
  c, s = math.cos(q[1]), math.sin(q[1])
  both = of.m2 * (of.along * math.cos(q[0] + q[1]) + of.across * math.sin(q[0] + q[1]))
  first += both + of.a2 * s * (2.0 * v[0] * v[1] + v[1] * v[1])
  second = torque[1] + both - of.a2 * s * v[0] * v[0]
  m11, m12, m22 = of.a1 + 2.0 * of.a2 * c, of.a3 + of.a2 * c, of.a3
  determinant = m11 * m22 - m12 * m12
  out[0] = (m22 * first - m12 * second) / determinant
  out[1] = (m11 * second - m12 * first) / determinant
