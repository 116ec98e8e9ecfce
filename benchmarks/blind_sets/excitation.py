"""Commands of the joints: sweeps, slow ramps, steps and multisines. T times, J joints."""

import numpy as np

APPROACH = 0.5
"""s in which a log goes from rest to its waveform."""


def sweep(t: np.ndarray, rng: np.random.Generator, center: np.ndarray, amplitude: np.ndarray):
  """Returns sines of rising frequency, 0.1-0.3 to 2-2.6 Hz, [T, J]."""
  phase = rng.uniform(-np.pi, np.pi, len(center)) if len(center) > 1 else np.zeros(1)
  low, high = rng.uniform(0.1, 0.3), rng.uniform(2.0, 2.6)
  turns = low * t + (high - low) * t**2 / (2 * t[-1])
  return _approach(t, center, center + amplitude * np.sin(2 * np.pi * turns[:, None] + phase))


def slow(t: np.ndarray, rng: np.random.Generator, center: np.ndarray, amplitude: np.ndarray):
  """Returns triangles with a period of 5 to 8 s, [T, J]: friction at low speed, both ways."""
  phase = rng.uniform(0, 1, len(center))
  place = (t[:, None] / rng.uniform(5.0, 8.0) + phase) % 1.0
  return _approach(t, center, center + amplitude * (4 * np.abs(place - 0.5) - 1))


def steps(t: np.ndarray, rng: np.random.Generator, center: np.ndarray, amplitude: np.ndarray):
  """Returns steps among five levels, held for 1.2 to 2 s, [T, J]."""
  commands = np.zeros((len(t), len(center)))
  for joint in range(len(center)):
    levels = rng.permutation([-1.0, -0.65, -0.3, 0.35, 0.7, 1.0])
    hold = rng.uniform(1.2, 2.0)
    index = np.floor((t + rng.uniform(0, hold)) / hold).astype(int) % len(levels)
    commands[:, joint] = center[joint] + amplitude[joint] * levels[index]
  return _approach(t, center, commands)


def multisine(t: np.ndarray, rng: np.random.Generator, center: np.ndarray, amplitude: np.ndarray):
  """Returns sums of seven sines, 0.2 to 2.4 Hz, of random phase, [T, J]."""
  commands = np.zeros((len(t), len(center)))
  for joint in range(len(center)):
    rates = rng.uniform(0.2, 2.4, 7)
    wave = np.sin(2 * np.pi * rates * t[:, None] + rng.uniform(-np.pi, np.pi, 7)).sum(axis=1)
    commands[:, joint] = center[joint] + amplitude[joint] * wave / np.abs(wave).max()
  return _approach(t, center, commands)


def _approach(t: np.ndarray, center: np.ndarray, commands: np.ndarray) -> np.ndarray:
  share = np.clip(t / APPROACH, 0.0, 1.0)[:, None]
  return center + share * (commands - center)


WAVES = {
  "train_1_sweep": sweep,
  "train_2_slow": slow,
  "train_3_steps": steps,
  "held_1_multisine": multisine,
  "held_2_sweep": sweep,
}
"""The logs of a set by file name; those that start with `held` are for reporting error only."""
