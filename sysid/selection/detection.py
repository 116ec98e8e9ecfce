"""Is there anything? Whitened tests of a residual, and what a race gains on healthy residuals.

Residuals of a good model are not white: encoders round, readings come late, friction remembers.
They are whitened by an autoregression before testing, and every threshold comes from resampling
whole blocks of seconds, which keeps what correlation is left.

Shapes: N samples, K regressors, C candidates.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.selection.race import Entry

Array = np.ndarray

_ORDER = 4  # of the autoregression
_DRAWS = 300  # resamplings
_BLOCK_S = 1.0  # s


def whiten(residual: Array, *, order: int = _ORDER) -> Array:
  """Returns the innovations of an autoregression fitted to the residual [N - order]."""
  rows = np.stack([residual[order - 1 - k : len(residual) - 1 - k] for k in range(order)], axis=1)
  target = residual[order:]
  coefficients = np.linalg.lstsq(rows, target, rcond=None)[0]
  return target - rows @ coefficients


def tests(problem: Problem, fit: Fit, *, seed: int = 0) -> dict[str, dict[str, float]]:
  """Returns, for each regressor, its correlation with the whitened residual and its p value.

  The p value is the share of block resamplings with random signs whose correlation is as large.
  """
  random = np.random.default_rng(seed)
  outputs = problem.simulate(fit.terms, fit.x)[0]
  innovations, regressors, blocks = [], [], []
  for index, (log, (along, _)) in enumerate(
    zip(problem.plant.logs, problem.errors(outputs), strict=True)
  ):
    white = whiten(np.where(problem.masks[index], along, 0.0))
    v, a = log.velocity[_ORDER:], log.acceleration[_ORDER:]
    command = np.interp(log.time, log.command_time, log.command)[_ORDER:]
    rows = np.stack(
      [log.position[_ORDER:], v, np.sign(v), a, v * np.abs(v), np.gradient(command)], axis=1
    )
    rows = rows - rows.mean(axis=0)
    regressors.append(rows / np.maximum(rows.std(axis=0), 1e-12))
    innovations.append(np.clip(white / max(white.std(), 1e-12), -5, 5))
    block = np.floor((log.time[_ORDER:] - log.time[0]) / _BLOCK_S).astype(int)
    blocks.append(block + 10_000 * index)
  r, x, labels = np.concatenate(innovations), np.concatenate(regressors), np.concatenate(blocks)
  _, labels = np.unique(labels, return_inverse=True)
  products = np.zeros((labels.max() + 1, x.shape[1]))
  np.add.at(products, labels, x * r[:, None])
  found = products.sum(axis=0) / len(r)
  signs = random.choice([-1.0, 1.0], size=(_DRAWS, len(products)))
  drawn = signs @ products / len(r)
  p = (1 + np.sum(np.abs(drawn) >= np.abs(found), axis=0)) / (1 + _DRAWS)
  names = ("position", "velocity", "direction", "acceleration", "squared speed", "command rate")
  return {
    name: {"correlation": round(float(c), 4), "p": round(float(q), 4)}
    for name, c, q in zip(names, found, p, strict=True)
  }


def chance_gain(
  problem: Problem, null: Entry, entries: Sequence[Entry], *, seed: int = 0
) -> dict[str, float]:
  """Returns what the best of a race's candidates gains on healthy residuals, in nats.

  Healthy residuals are those of the best hypothesis, resampled in blocks with random signs. What a
  candidate can gain on them is their projection onto what it changes in the simulated positions,
  beside what the calibration changes.
  """
  random = np.random.default_rng(seed)
  best = min([null, *entries], key=lambda e: e.score)
  healthy = _positions(problem, best.fit)
  base = _positions(problem, null.fit)
  changes = np.array([base - _positions(problem, e.fit) for e in entries])
  own = problem.residuals(null.fit.terms, _moved(null.fit))
  count = len(base)
  calibrated = _position_rows(problem, own[1:] - own[0], count)
  basis = np.linalg.qr(calibrated.T)[0] if len(calibrated) else np.zeros((count, 0))
  changes = changes - (changes @ basis) @ basis.T
  norms = np.linalg.norm(changes, axis=1, keepdims=True)
  changes = changes / np.maximum(norms, 1e-9)
  labels = np.concatenate(
    [
      np.floor((log.time[mask] - log.time[0]) / _BLOCK_S).astype(int) + 10_000 * i
      for i, (log, mask) in enumerate(zip(problem.plant.logs, problem.masks, strict=True))
    ]
  )
  _, labels = np.unique(labels, return_inverse=True)
  gains = []
  for _ in range(_DRAWS):
    signs = random.choice([-1.0, 1.0], size=labels.max() + 1)
    drawn = healthy * signs[labels]
    drawn = drawn - basis @ (basis.T @ drawn)
    share = np.square(changes @ drawn).max() / max(float(drawn @ drawn), 1e-12)
    gains.append(-0.5 * np.log(max(1.0 - share, 1e-6)))
  return {"median": float(np.median(gains)), "q95": float(np.quantile(gains, 0.95))}


def _positions(problem: Problem, fit: Fit) -> Array:
  outputs = problem.simulate(fit.terms, fit.x)[0]
  parts = [along[m] for (along, _), m in zip(problem.errors(outputs), problem.masks, strict=True)]
  return np.clip(np.concatenate(parts), -50, 50)


def _moved(fit: Fit) -> Array:
  scale = np.concatenate([np.zeros(0), *[t.scale for t in fit.terms]])
  return np.vstack([fit.x, fit.x + 0.05 * np.diag(scale)])


def _position_rows(problem: Problem, rows: Array, count: int) -> Array:
  """Returns the part of residual rows [B, R] that belongs to positions [B, count]."""
  if problem.channel == "none":
    return rows[:, :count]
  parts, at = [], 0
  for mask in problem.masks:
    size = int(mask.sum())
    parts.append(rows[:, at : at + size])
    at += 2 * size
  return np.concatenate(parts, axis=1)
