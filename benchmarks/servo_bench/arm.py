"""The arm on the output shaft: inertia, gravity, and what pulls at it on the bench.

In the plane across the axis, whose two directions and the axis are right-handed, an arm turned by q
has its first moment m r at (s1 cos q - s2 sin q, s1 sin q + s2 cos q).
"""

import math
from typing import NamedTuple

import numba


class Arm(NamedTuple):
  """Constants."""

  inertia: float
  """kg m^2, about the axis."""
  moment_1: float
  """kg m, s1."""
  moment_2: float
  """kg m, s2."""
  gravity_1: float
  """m/s^2, along the plane's first direction."""
  gravity_2: float
  """m/s^2, along its second."""
  spring: float
  """N m/rad."""
  spring_angle: float
  """rad, where that spring pulls nothing."""
  stop: float
  """N m/rad, of a spring that only pushes back, beyond `stop_angle`."""
  stop_angle: float
  """rad; the stop is at larger angles if it is positive, at smaller ones otherwise."""
  drag: float
  """N m s^2/rad^2."""
  ripple: float
  """N m, of a torque that repeats with the angle."""
  ripple_periods: float
  """1/rad."""
  ripple_phase: float
  """rad, at angle 0."""
  cable: float
  """N m/rad, of a cable that is dragged along."""
  cable_slip: float
  """rad, by which it bends before it slips."""
  tip_share: float
  """1, of inertia and moment that is behind a flexible joint in the link; 0: it is stiff."""
  tip_frequency: float
  """rad/s, of that part on a hub that is held."""
  tip_damping: float
  """1, damping ratio of that."""


@numba.njit
def weight(arm: Arm, angle: float) -> float:
  """Returns gravity's torque [N m] at an angle [rad]."""
  c, s = math.cos(angle), math.sin(angle)
  along_1 = arm.moment_1 * c - arm.moment_2 * s
  along_2 = arm.moment_1 * s + arm.moment_2 * c
  return along_1 * arm.gravity_2 - along_2 * arm.gravity_1


@numba.njit
def pull(arm: Arm, angle: float, speed: float, bent: float) -> float:
  """Returns the torque [N m] of springs, drag, ripple and cable.

  Args:
    arm: constants.
    angle: rad.
    speed: rad/s.
    bent: of the cable, rad.
  """
  torque = -arm.spring * (angle - arm.spring_angle) - arm.drag * abs(speed) * speed
  torque -= arm.cable * bent
  if arm.ripple > 0.0:
    torque += arm.ripple * math.sin(arm.ripple_periods * angle + arm.ripple_phase)
  beyond = angle - arm.stop_angle
  if arm.stop > 0.0 and beyond * arm.stop_angle > 0.0:
    torque -= arm.stop * beyond
  return torque
