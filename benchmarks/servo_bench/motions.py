"""What the host tells the servo: two kinds of motion are held out, three are to identify from."""

import math
from typing import NamedTuple

import numpy as np

Array = np.ndarray
Random = np.random.Generator


class Reach(NamedTuple):
  """How far and how fast a bench is moved."""

  angle: float
  """rad, to either side."""
  speed: float
  """rad/s."""


def sweep(t: Array, reach: Reach, random: Random) -> Array:
  """Returns a logarithmic chirp [rad] of falling amplitude, 0.2 Hz to 2.5 to 4 Hz."""
  last, duration = random.uniform(2.5, 4.0), t[-1]
  growth = math.log(last / 0.2) / duration
  turns = 0.2 * (np.exp(growth * t) - 1.0) / growth
  amplitude = np.minimum(reach.angle, reach.speed / (math.tau * 0.2 * np.exp(growth * t)))
  return amplitude * np.sin(math.tau * turns)


def slow(t: Array, reach: Reach, random: Random) -> Array:
  """Returns slow ramps [rad] between turning points that lie wider and closer."""
  speed = random.uniform(0.35, 0.7)
  turns, where, side = [0.0], 0.0, random.choice([-1.0, 1.0])
  at = [0.0]
  while at[-1] < t[-1]:
    to = side * reach.angle * random.uniform(0.1, 1.0)
    at.append(at[-1] + max(abs(to - where) / speed, 0.05))
    turns.append(to)
    where, side = to, -side
  return np.interp(t, at, turns)


def steps(t: Array, reach: Reach, random: Random) -> Array:
  """Returns steps [rad] between random angles, each held for 0.6 to 1.2 s."""
  goal, where, until = np.empty_like(t), 0.0, 0.6
  for k, now in enumerate(t):
    if now >= until:
      far = random.uniform(0.25, 1.1) * reach.angle
      where = where - far if where > 0 else where + far
      until = now + random.uniform(0.6, 1.2)
    goal[k] = where
  return goal


def point_to_point(t: Array, reach: Reach, random: Random) -> Array:
  """Returns minimum-jerk motions [rad] with rests between, x (10 - 15 s + 6 s^2) s^3.

  Source: Flash and Hogan 1985, The coordination of arm movements, appendix A.
  """
  goal, where, start = np.zeros_like(t), 0.0, 0.3
  while start < t[-1]:
    to = reach.angle * random.uniform(-1.0, 1.0)
    # The peak of a minimum-jerk motion is 15/8 of its mean speed.
    takes = max(1.875 * abs(to - where) / reach.speed, 0.25) * random.uniform(1.0, 1.6)
    s = np.clip((t - start) / takes, 0.0, 1.0)
    moved = where + (to - where) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    goal = np.where(t >= start, moved, goal)
    where, start = to, start + takes + random.uniform(0.0, 0.7)
  return goal


def filtered_noise(t: Array, reach: Reach, random: Random) -> Array:
  """Returns noise [rad] through two first-order low-passes of 0.8 to 1.3 Hz, from 0."""
  keep = math.exp(-math.tau * random.uniform(0.8, 1.3) * (t[1] - t[0]))
  draws = random.standard_normal(t.size)
  goal, first, second = np.empty_like(t), 0.0, 0.0
  for k, draw in enumerate(draws):
    first = keep * first + (1.0 - keep) * draw
    second = keep * second + (1.0 - keep) * first
    goal[k] = second
  goal *= np.minimum(t / 0.5, 1.0)
  fastest = np.abs(np.diff(goal)).max() / (t[1] - t[0])
  return goal * min(reach.angle / np.abs(goal).max(), reach.speed / fastest)


TRAIN = {"1_sweep": (sweep, 14.0), "2_slow": (slow, 14.0), "3_steps": (steps, 14.0)}
"""Motion and duration [s] by the name of the log."""
HELD = {"1_points": (point_to_point, 12.0), "2_noise": (filtered_noise, 12.0)}
