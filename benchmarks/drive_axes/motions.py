"""Commands: three kinds of motion to identify from, two others to be judged on.

Each is a function of times [M] s, from 0, and what an axis can do; it returns goals [M] about 0.
"""

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray
Random = np.random.Generator


class Reach(NamedTuple):
  """What a motion may ask of an axis: rad or m, per s and s^2."""

  amplitude: float
  speed: float
  acceleration: float


def sweep(t: Array, reach: Reach, random: Random) -> Array:
  """Returns a chirp of rising frequency whose amplitude keeps speed and acceleration."""
  low, high = random.uniform(0.12, 0.25), random.uniform(1.4, 2.4)  # Hz
  duration = t[-1]
  rate = math.log(high / low) / duration
  phase = math.tau * low * np.expm1(rate * t) / rate
  omega = math.tau * low * np.exp(rate * t)
  amplitude = np.minimum(reach.amplitude, 0.8 * reach.speed / omega)
  amplitude = np.minimum(amplitude, 0.8 * reach.acceleration / omega**2)
  return random.choice([-1.0, 1.0]) * amplitude * np.sin(phase)


def triangle(t: Array, reach: Reach, random: Random) -> Array:
  """Returns a slow triangle whose corners lie at random places on alternate sides."""
  speed = reach.speed * random.uniform(0.1, 0.2)
  corners, times, side = [0.0], [0.0], random.choice([-1.0, 1.0])
  while times[-1] < t[-1]:
    corners.append(side * reach.amplitude * random.uniform(0.25, 0.9))
    times.append(times[-1] + abs(corners[-1] - corners[-2]) / speed)
    side = -side
  return np.interp(t, times, corners)


def ramps(t: Array, reach: Reach, random: Random) -> Array:
  """Returns fast ramps between places where the axis dwells, a step now and then."""
  places, times = [0.0, 0.0], [0.0, random.uniform(0.2, 0.5)]
  while times[-1] < t[-1]:
    place = reach.amplitude * random.uniform(-0.9, 0.9)
    ramp = abs(place - places[-1]) / (reach.speed * random.uniform(0.5, 0.8))
    if random.uniform() < 0.15:
      place, ramp = places[-1] + 0.12 * reach.amplitude * random.choice([-1.0, 1.0]), 1e-3
    places += [place, place]
    times += [times[-1] + ramp, times[-1] + ramp + random.uniform(0.3, 0.9)]
  return np.interp(t, times, places)


def points(t: Array, reach: Reach, random: Random) -> Array:
  """Returns minimum-jerk motions from point to point (Flash, Hogan 1985, equation 2)."""
  goals, start, place = np.zeros_like(t), 0.0, 0.0
  while start < t[-1]:
    target = reach.amplitude * random.uniform(-0.9, 0.9)
    way = abs(target - place)
    # The peaks of a minimum jerk are 15/8 way/T and 10/sqrt(3) way/T^2.
    least = max(1.875 * way / reach.speed, math.sqrt(5.774 * way / reach.acceleration))
    length = least * random.uniform(1.1, 1.8) + 0.1
    s = np.clip((t - start) / length, 0.0, 1.0)
    goals += (target - place) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    place, start = target, start + length + random.uniform(0.0, 0.5)
  return goals


def wander(t: Array, reach: Reach, random: Random) -> Array:
  """Returns low-pass noise: sines of random frequencies to 1.2 Hz that fade in."""
  f = random.uniform(0.08, 1.2, 14)
  parts = np.sin(math.tau * np.outer(t, f) + random.uniform(0.0, math.tau, f.size)) / (f + 0.2)
  fade = np.clip(t / 2.0, 0.0, 1.0)
  x = parts.sum(1) * fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2)
  v = np.gradient(x, t)
  most = (np.abs(x).max(), np.abs(v).max(), np.abs(np.gradient(v, t)).max())
  return x * min(0.9 * allowed / found for allowed, found in zip(reach, most, strict=True))


TRAIN = {"1_sweep": sweep, "2_slow": triangle, "3_ramps": ramps}
HELD = {"1_points": points, "2_wander": wander}
