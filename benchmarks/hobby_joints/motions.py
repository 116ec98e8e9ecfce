"""What machines are told: commands [M] of one joint at times [M] s, from its centre."""

import numpy as np

from benchmarks.hobby_joints.machines import Range

Array = np.ndarray
Random = np.random.Generator
_EASE = 1.0  # s in which periodic motions begin


def sweep(times: Array, where: Range, random: Random) -> Array:
  """A chirp to 2 or 3 Hz, smaller where it would be too fast."""
  first, last = random.uniform(0.1, 0.2), random.uniform(1.8, 3.0)
  frequency = first * (last / first) ** (times / times[-1])
  phase = 2.0 * np.pi * np.cumsum(frequency) * (times[1] - times[0])
  size = np.minimum(where.amplitude, where.speed / (2.0 * np.pi * frequency))
  return where.centre + random.choice([-1.0, 1.0]) * size * _eased(times) * np.sin(phase)


def slow(times: Array, where: Range, random: Random) -> Array:
  """A slow triangle or sine whose width grows or shrinks."""
  period, widths = random.uniform(2.0, 4.5), random.uniform(0.4, 1.0, 2)
  wave = np.sin(2.0 * np.pi * times / period)
  if random.uniform() < 0.6:
    wave = 2.0 / np.pi * np.arcsin(wave)
  size = where.amplitude * np.interp(times, [0.0, times[-1]], widths)
  return where.centre + random.choice([-1.0, 1.0]) * size * wave


def steps(times: Array, where: Range, random: Random) -> Array:
  """Random places, each reached within a tenth of a second or so."""
  knots, goals = [0.0], [0.0]
  while knots[-1] < times[-1]:
    begin = knots[-1] + random.uniform(0.3, 1.1)
    goal = random.uniform(-0.9, 0.9)
    rise = max(0.04, where.amplitude * abs(goal - goals[-1]) / (3.0 * where.speed))
    knots += [begin, begin + rise]
    goals += [goals[-1], goal]
  return where.centre + where.amplitude * np.interp(times, knots, goals)


def wander(times: Array, where: Range, random: Random) -> Array:
  """A sum of eleven sines with random phases, up to 1.8 Hz."""
  frequency = np.geomspace(0.12, 1.8, 11) * random.uniform(0.95, 1.05, 11)
  phase, size = random.uniform(0.0, 2.0 * np.pi, 11), frequency**-0.8
  course = size @ np.sin(2.0 * np.pi * frequency[:, None] * times + phase[:, None])
  speed = np.abs(np.gradient(course, times)).max()
  scale = min(where.amplitude / np.abs(course).max(), where.speed / speed)
  return where.centre + scale * _eased(times) * course


def points(times: Array, where: Range, random: Random) -> Array:
  """From point to point as a cosine goes, with rests."""
  course, at, place = np.zeros_like(times), random.uniform(0.2, 0.5), 0.0
  while at < times[-1]:
    goal = random.uniform(-1.0, 1.0)
    span = abs(goal - place) * where.amplitude * np.pi / (2.0 * where.speed)
    span = max(0.15, random.uniform(1.0, 2.0) * span)
    course[times >= at] = place
    share = np.clip((times - at) / span, 0.0, 1.0)
    course += (goal - place) * 0.5 * (1.0 - np.cos(np.pi * share)) * (times >= at)
    at, place = at + span + random.uniform(0.1, 0.7), goal
  return where.centre + where.amplitude * course


def _eased(times: Array) -> Array:
  share = np.clip(times / _EASE, 0.0, 1.0)
  return share * share * (3.0 - 2.0 * share)


TRAIN = {"1_sweep": sweep, "2_slow": slow, "3_steps": steps}
HELD = {"1_wander": wander, "2_points": points}
