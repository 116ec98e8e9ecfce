"""References for the joints: exponential chirps, trapezoids of speed, steps, minimum jerk.

Shapes: C times, n joints. Every motion begins at rest at the centre.
"""

import numpy as np

Array = np.ndarray

_QUICK = 8.0  # times slow travel: the fastest point to point
_PEAK = 1.875  # of a minimum-jerk move's speed over its mean


def chirp(time: Array, rng: np.random.Generator, center: Array, reach: Array, speed: float):
  """Returns exponential chirps [C, n] (Farina 2000), 0.15-0.25 to 2-3.5 Hz, fading at both ends."""
  low, high = rng.uniform(0.15, 0.25), rng.uniform(2.0, 3.5)
  rise = np.log(high / low) / time[-1]
  phase = 2 * np.pi * low / rise * np.expm1(rise * time)
  shift = rng.uniform(-np.pi, np.pi, len(center))
  # Amplitude falls with frequency: constant acceleration would be a square, this is between.
  size = np.exp(-0.45 * rise * time) * np.minimum(1.0, np.minimum(time, time[-1] - time) / 0.7)
  return center + reach * size[:, None] * np.sin(phase[:, None] + shift)


def trapezoids(time: Array, rng: np.random.Generator, center: Array, reach: Array, speed: float):
  """Returns runs at constant speed between random points, with pauses, [C, n]."""
  columns = []
  for joint in range(len(center)):
    run = speed * rng.uniform(0.4, 1.3)
    points, here = [0.0], 0.0
    moves = [rng.uniform(0.1, 0.5)]  # durations, the first a pause
    while sum(moves) < time[-1]:
      there = float(rng.uniform(0.3, 1.0) * (-np.sign(here) or rng.choice([-1, 1])))
      points += [here, there]
      moves += [abs(there - here) * reach[joint] / run, rng.uniform(0.05, 0.6)]
      here = there
    points.append(here)
    wave = np.interp(time, np.cumsum([0.0, *moves])[: len(points)], points)
    columns.append(center[joint] + reach[joint] * _smooth(wave, time, 0.06))
  return np.stack(columns, axis=1)


def steps(time: Array, rng: np.random.Generator, center: Array, reach: Array, speed: float):
  """Returns random levels held for random times, 0.5 to 1.8 s, [C, n]."""
  columns = []
  for joint in range(len(center)):
    times = np.cumsum([0.4, *rng.uniform(0.5, 1.8, int(time[-1] / 0.5) + 2)])
    levels = np.concatenate([[0.0], rng.uniform(-1, 1, len(times))])
    columns.append(center[joint] + reach[joint] * levels[np.searchsorted(times, time, "right")])
  return np.stack(columns, axis=1)


def points(time: Array, rng: np.random.Generator, center: Array, reach: Array, speed: float):
  """Returns minimum-jerk moves from point to point [C, n] (Flash and Hogan 1985)."""
  columns = []
  for joint in range(len(center)):
    wave, begin, here = np.zeros(len(time)), 0.3, 0.0
    while begin < time[-1]:
      length, there = rng.uniform(0.35, 1.4), rng.uniform(-0.9, 0.9)
      quickest = _PEAK * abs(there - here) * reach[joint] / (_QUICK * speed)
      length = max(length, quickest)
      s = np.clip((time - begin) / length, 0, 1)
      wave += (there - here) * s**3 * (10 - 15 * s + 6 * s**2)
      begin, here = begin + length + rng.uniform(0.0, 0.5), there
    columns.append(center[joint] + reach[joint] * wave)
  return np.stack(columns, axis=1)


def _smooth(wave: Array, time: Array, width: float) -> Array:
  """Returns a moving mean over a width [s]: runs begin and end at finite acceleration."""
  count = max(1, round(width / (time[1] - time[0])))
  padded = np.concatenate([np.full(count - 1, wave[0]), wave])
  return np.convolve(padded, np.full(count, 1 / count), mode="valid")


TRAIN = {"train_1_chirp": chirp, "train_2_trapezoids": trapezoids, "train_3_steps": steps}
HELD = {"held_1_points": points}
