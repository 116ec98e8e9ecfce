"""Noise of readings, from their scatter about smooth motion and their resolution.

And for how long what is left of readings goes together.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.model.plant import JointPlant

Array = np.ndarray

_NINE_TENTHS = 0.79  # rms of the inner 90 % of a normal distribution over its own


def effort_noise(efforts: Sequence[Array]) -> float:
  """Returns the noise of effort readings: the median of second differences, at least a step."""
  steps = [quantum(e) for e in efforts]
  jitter = [float(np.median(np.abs(np.diff(e, n=2)))) / 1.65 for e in efforts]
  return max(*steps, float(np.median(jitter)), 1e-9)


def timing(plant: JointPlant) -> tuple[float, float]:
  """Returns the noise of readings at rest and how far their stamps are off, rad (m) and s.

  Readings of a joint that moves at v scatter by the noise at rest and by v times the stamps' error.
  """
  scatter, speed = [], []
  for log in plant.logs:
    scatter.append(np.diff(log.position, n=3) ** 2 / 20.0)
    speed.append(log.velocity[2:-1] ** 2)
  s, v = np.concatenate(scatter), np.concatenate(speed)
  slow, fast = v <= np.quantile(v, 0.3), v >= np.quantile(v, 0.8)
  resolutions = [quantum(log.position) for log in plant.logs]  # 0 of a log without motion
  steps = min((r for r in resolutions if r > 0.0), default=0.0) / np.sqrt(12.0)
  rest = max(float(_trimmed(s[slow])), steps**2, 1e-18)
  error = max(_trimmed(s[fast]) - rest, 0.0) / max(float(v[fast].mean()), 1e-18)
  return float(np.sqrt(rest)), float(np.sqrt(error))


def _trimmed(values: Array) -> float:
  """Returns the mean of the lower 90 %, made that of all for normal noise."""
  kept = values[values <= np.quantile(values, 0.9)]
  return float(kept.mean()) / _NINE_TENTHS**2 if len(kept) else 0.0


def correlation_time(row: Array, length: int) -> float:
  """Returns the integrated autocorrelation time in samples, up to where it falls below 0.05.

  Args:
    row: residuals [N] about what they are expected to be.
    length: samples over which it is looked for.
  """
  power = np.abs(np.fft.rfft(row, 2 * len(row))) ** 2
  correlation = np.fft.irfft(power)[: 2 * length]
  correlation = correlation / max(correlation[0], 1e-30)
  small = np.flatnonzero(correlation < 0.05)
  end = small[0] if len(small) else len(correlation)
  return float(max(1.0, 1.0 + 2.0 * correlation[1:end].sum()))


def once(readings: Array) -> Array:
  """Returns what readings [N] count: those that repeat the one before are one together."""
  first = np.flatnonzero(np.append(True, np.diff(readings) != 0.0))
  lengths = np.diff(np.append(first, len(readings)))
  return np.repeat(1.0 / lengths, lengths)
