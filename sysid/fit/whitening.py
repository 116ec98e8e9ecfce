"""What a residual still goes with: correlations of its innovations, by resampling blocks.

Residuals of a good model are not white: encoders round, readings come late, friction remembers.
They are whitened by an autoregression first; whole blocks of seconds are resampled, which keeps
what correlation is left. Shapes: N samples.
"""

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood

Array = np.ndarray

_ORDER = 4  # of the autoregression
_DRAWS = 300  # resamplings


def whiten(residual: Array) -> Array:
  """Returns the innovations of an autoregression fitted to the residual [N - _ORDER]."""
  rows = np.stack([residual[_ORDER - 1 - k : len(residual) - 1 - k] for k in range(_ORDER)], axis=1)
  target = residual[_ORDER:]
  coefficients = np.linalg.lstsq(rows, target, rcond=None)[0]
  return target - rows @ coefficients


def tests(joint: JointLikelihood, residual: Array) -> dict[str, dict[str, float]]:
  """Returns, for each regressor, its correlation with the whitened residual and its p value.

  The p value is the share of block resamplings with random signs whose correlation is as large.

  Args:
    joint: the logs.
    residual: of positions [N], all logs.
  """
  random = np.random.default_rng(0)
  innovations, regressors, blocks, start = [], [], [], 0
  for index, log in enumerate(joint.plant.logs):
    end = start + len(log.time)
    white = whiten(residual[start:end])
    start = end
    v, a = log.velocity[_ORDER:], log.acceleration[_ORDER:]
    command = np.interp(log.time, log.command_time, log.command)[_ORDER:]
    rows = np.stack(
      [log.position[_ORDER:], v, np.sign(v), a, v * np.abs(v), np.gradient(command)], axis=1
    )
    rows = rows - rows.mean(axis=0)
    regressors.append(rows / np.maximum(rows.std(axis=0), 1e-12))
    innovations.append(np.clip(white / max(white.std(), 1e-12), -5, 5))
    block = np.floor((log.time[_ORDER:] - log.time[0]) / joint.settings.block_s).astype(int)
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
