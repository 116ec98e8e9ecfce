"""Dry and viscous friction of motor and gear: the LuGre model, whose level may depend on much.

Source: Canudas de Wit, Olsson, Astrom and Lischinsky 1995, A new model for control of systems with
friction, equations 2 to 5; bristle damping that falls with speed keeps it passive (Olsson et al.
1998, section 4).
"""

import math
from typing import NamedTuple

import numba

_SLOWEST = 1e-9
"""N m, of a level; against division by zero."""


class Friction(NamedTuple):
  """Constants at the output shaft, on the rotor's side of the play."""

  coulomb: float
  """N m, in motion without load."""
  positive: float
  """N m, more of it in positive motion."""
  negative: float
  """N m, more of it in negative motion."""
  breakaway: float
  """N m, at rest beyond that in motion."""
  stribeck_speed: float
  """rad/s, of the fall from rest to motion."""
  viscous: float
  """N m s/rad."""
  load: float
  """1, dry friction per torque between the teeth."""
  stiffness: float
  """N m/rad, of the bristles."""
  damping: float
  """N m s/rad, of the bristles."""
  cold: float
  """1, share by which all friction is larger at the start."""
  warming_time: float
  """s, in which that goes."""
  patch: float
  """N m, more of it around an angle."""
  patch_angle: float
  """rad."""
  patch_width: float
  """rad, from its middle to 1/e."""


@numba.njit
def stribeck(friction: Friction, speed: float) -> float:
  """Returns exp(-(v / vs)^2)."""
  ratio = speed / friction.stribeck_speed
  return math.exp(-ratio * ratio)


@numba.njit
def coldness(friction: Friction, time: float) -> float:
  """Returns by how much friction is larger now than when warm, 1 or more."""
  return 1.0 + friction.cold * math.exp(-time / friction.warming_time)


@numba.njit
def level(friction: Friction, speed: float, load: float, angle: float, fall: float) -> float:
  """Returns the dry friction [N m] that steady sliding has, g(v) of the LuGre model.

  Args:
    friction: constants.
    speed: rad/s.
    load: torque between the teeth, N m.
    angle: rad, of the output.
    fall: `stribeck` at this speed.
  """
  dry = friction.coulomb + friction.load * abs(load) + friction.breakaway * fall
  dry += friction.positive if speed > 0.0 else friction.negative
  if friction.patch > 0.0:
    away = (angle - friction.patch_angle) / friction.patch_width
    dry += friction.patch * math.exp(-away * away)
  return max(dry, _SLOWEST)


@numba.njit
def bent(bristle: float, speed: float, dry: float, stiffness: float, step: float) -> float:
  """Returns the bristles' deflection [rad] after a step, exact at constant speed:
  dz/dt = v - s |v| z / g.

  Args:
    bristle: z, rad, before.
    speed: v, rad/s.
    dry: g, N m.
    stiffness: s, N m/rad.
    step: s.
  """
  if speed == 0.0:
    return bristle
  end = math.copysign(dry / stiffness, speed)
  return end + (bristle - end) * math.exp(-stiffness * abs(speed) * step / dry)


def steady(friction: Friction, speed: float, load: float = 0.0) -> float:
  """Returns the torque [N m] of steady sliding far from any patch, warm: g(v) sign(v) + s2 v."""
  dry = level(friction, speed, load, math.inf, stribeck(friction, speed))
  return math.copysign(dry, speed) + friction.viscous * speed
