"""The gear behind a motor: LuGre friction, teeth that give way, and what else pulls at the link.

Bristles z bend before they slide (Canudas de Wit, Olsson, Astrom, Lischinsky 1995, eqs. 2 to 5):
dz/dt = v - s0 |v| z / g(v), friction = s0 z + s1 dz/dt; g is the level at which they slide.
All fields are [n], in rad and N m, of a jaw m and N.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

Array = np.ndarray


class Gear(NamedTuple):
  """Constants of each joint's gear and link."""

  dry: Array
  rest: Array  # what dry friction has more at rest
  rest_speed: Array
  reach: Array  # rad that bristles bend before they slide, without a load
  of_load: Array  # friction per torque that the teeth pass
  viscous: Array
  stiffness: Array  # of the teeth
  damping: Array
  gap: Array  # full width of the play
  # Without these a machine is healthy.
  more_rest: Array  # a second fall with speed
  more_speed: Array
  forward: Array  # more friction in positive motion
  backward: Array
  drag: Array  # per squared speed
  ripple: Array  # torque that repeats with position
  ripples: Array  # 1/rad
  ripple_phase: Array
  spring: Array
  spring_at: Array
  spot: Array  # more friction around a place
  spot_at: Array
  spot_width: Array
  stop: Array  # N m/rad beyond a place
  stop_at: Array
  cable: Array  # N m/rad of a bundle with hysteresis
  cable_reach: Array  # rad at which it yields
  change: Array  # factor of all friction
  change_at: Array  # s, when it comes
  slip: Array  # torque at which the hub turns on its shaft
  loose: Array  # inertia that the link takes along within a play
  loose_gap: Array


@numba.njit(cache=True)
def level(gear: Gear, j: int, place: float, speed: float, load: float, time: float) -> float:
  """Returns the friction at which bristles slide, g(v) in N m."""
  sliding = gear.dry[j] + gear.of_load[j] * abs(load)
  sliding += gear.rest[j] * math.exp(-((speed / gear.rest_speed[j]) ** 2))
  if gear.more_rest[j] > 0.0:
    sliding += gear.more_rest[j] * math.exp(-((speed / gear.more_speed[j]) ** 2))
  sliding += gear.forward[j] if speed > 0.0 else gear.backward[j]
  if gear.spot[j] > 0.0:
    sliding += gear.spot[j] * math.exp(-(((place - gear.spot_at[j]) / gear.spot_width[j]) ** 2))
  return sliding * gear.change[j] if time > gear.change_at[j] else sliding


@numba.njit(cache=True)
def bend(z: float, speed: float, sliding: float, stiffness: float, step: float) -> float:
  """Returns the bristles' deflection after a step: the law's exact solution at a steady speed."""
  if speed == 0.0:
    return z
  end = math.copysign(sliding / stiffness, speed)
  return end + (z - end) * math.exp(-stiffness * abs(speed) * step / sliding)


@numba.njit(cache=True)
def teeth(twist: float, rate: float, gap: float, stiffness: float, damping: float) -> float:
  """Returns the torque that teeth pass when the rotor is ahead of the link by a twist."""
  bent = max(twist - 0.5 * gap, 0.0) + min(twist + 0.5 * gap, 0.0)
  if bent == 0.0 and gap > 0.0:
    return 0.0
  torque = stiffness * bent + damping * rate
  # Teeth push, they do not pull.
  return torque if gap == 0.0 or torque * bent > 0.0 else 0.0


@numba.njit(cache=True)
def pulled(gear: Gear, j: int, place: float, speed: float, bundle: float) -> float:
  """Returns what the link is pulled by beside gravity and its gear, N m."""
  torque = -gear.drag[j] * abs(speed) * speed - gear.cable[j] * bundle
  torque -= gear.spring[j] * (place - gear.spring_at[j])
  return torque - gear.stop[j] * max(place - gear.stop_at[j], 0.0)


@numba.njit(cache=True)
def yielding(bundle: float, speed: float, reach: float) -> float:
  """Returns the rate of a bundle's stretch: Bouc and Wen's law with exponent 2, at most `reach`."""
  share = bundle / reach
  return speed - 0.5 * (abs(speed) * share * abs(share) + speed * share * share)


def healthy(n: int, **values: Array) -> Gear:
  """Returns a gear of n joints with all that is not given off."""
  off = {name: np.zeros(n) for name in Gear._fields}
  far = {name: np.full(n, np.inf) for name in ("change_at", "slip", "stop_at")}
  ones = {name: np.ones(n) for name in ("more_speed", "spot_width", "cable_reach", "change")}
  return Gear(**{**off, **far, **ones, **values})
