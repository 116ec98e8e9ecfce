"""A learned force for what has no name: smooth over position and velocity, as a stopgap.

The residual torque of the measured motion is regressed on the features of
`suite.effects.residual_force`; the table is kept only if simulating with it lowers the error on
logs that it was not fitted to (blocks of time where there is one log).
"""

import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.suite.effects.residual import features
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.hypotheses.terms import compose
from nerf2real.sysid.selection.race import folds_by_log

Array = np.ndarray

_GRID = (7, 7)  # positions, velocities
_RIDGE = 1e-3  # of the mean square of a feature
_SHARES = (1.0, 0.7, 0.4)  # of the regressed force that are tried


def learn(problem: Problem, fit: Fit) -> tuple[Effect | None, float, float]:
  """Fits a residual force beside a hypothesis.

  Returns:
    The effect (None if it does not help), and the rms of positions [m or rad] on what was left out
    without and with it.
  """
  before: list[float] = []
  after: dict[float, list[float]] = {share: [] for share in _SHARES}
  for fitted, held in folds_by_log(problem):
    effect = _regress(problem, fit, fitted)
    before.append(_rms(problem, fit, None, 0.0, held))
    for share in _SHARES:
      after[share].append(_rms(problem, fit, effect, share, held))
  means = {share: float(np.mean(values)) for share, values in after.items()}
  best = min(means, key=lambda share: means[share])
  without = float(np.mean(before))
  if means[best] > 0.95 * without:
    return None, without, without
  effect = _regress(problem, fit, list(problem.masks))
  weights = [best * float(w) for w in np.ravel(effect.parameters["weights"])]
  return effect.replace(weights=weights), without, means[best]


def table_of(effect: Effect, share: float = 1.0) -> tuple[Array, Array]:
  """Returns the kernel's table: weights [P, V] and bounds [4]."""
  p = effect.parameters
  shape = int(p["num_positions"]), int(p["num_velocities"])  # type: ignore[arg-type]
  bounds = [p["position_low"], p["position_high"], p["velocity_low"], p["velocity_high"]]
  return share * np.reshape(p["weights"], shape).astype(float), np.array(bounds, float)


def _regress(problem: Problem, fit: Fit, masks: list[Array]) -> Effect:
  inner = slice(signatures.EDGES, -signatures.EDGES)
  parts = [signatures.torque_residual(problem, fit, i) for i in range(len(masks))]
  keep = [mask[inner] for mask in masks]
  q = np.concatenate([p.position[k] for p, k in zip(parts, keep, strict=True)])
  v = np.concatenate([p.velocity[k] for p, k in zip(parts, keep, strict=True)])
  r = np.concatenate([-p.residual[k] for p, k in zip(parts, keep, strict=True)])
  compose_p, _ = compose(problem.plant, fit.terms, fit.x)
  friction = float(compose_p[8])
  r = r + friction * np.tanh(v / max(1e-3, 0.02 * float(np.abs(v).max())))
  low_q, high_q = np.quantile(q, [0.005, 0.995])
  fast = max(float(np.quantile(np.abs(v), 0.995)), 1e-6)
  limit = 4 * float(np.median(np.abs(r))) + 1e-12
  effect = Effect(
    "residual_force",
    problem.plant.joint,
    {
      "num_positions": _GRID[0],
      "num_velocities": _GRID[1],
      "position_low": float(low_q),
      "position_high": float(max(high_q, low_q + 1e-6)),
      "velocity_low": -fast,
      "velocity_high": fast,
      "weights": [0.0] * (_GRID[0] * _GRID[1]),
    },
  )
  x = features(q, v, effect)
  normal = x.T @ x
  normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
  weights = np.linalg.solve(normal, x.T @ np.clip(r, -limit, limit))
  return effect.replace(weights=[float(w) for w in weights])


def _rms(
  problem: Problem, fit: Fit, effect: Effect | None, share: float, masks: list[Array]
) -> float:
  p, changed = compose(problem.plant, fit.terms, fit.x)
  table = None if effect is None else table_of(effect, share)
  outputs = problem.plant.simulate(p[None], surroundings=[changed], table=table)[0]
  squares = [
    np.square((log.position - o[0])[m])
    for log, o, m in zip(problem.plant.logs, outputs, masks, strict=True)
  ]
  return float(np.sqrt(np.mean(np.concatenate(squares))))
