"""Searches where derivatives mislead: stairs that held commands make, and courses through play."""

from collections.abc import Collection

import numpy as np

from nerf2real.sysid.fit.layout import Fit
from nerf2real.sysid.fit.posterior import FINE, Fitter

STAIRS = ("delay", "rate")
"""Values of effects by which held commands come at other times."""
_SHIFTS = tuple(0.0005 * k for k in (-8, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 8))
"""s by which latencies are shifted to look about, and the ends of logs by a clock's rate."""
_WORTH = 0.5  # nats that other latencies, or values drawn, must be better by, chosen
_GENERATIONS, _DRAWN, _ELITE = 12, 120, 20  # of values that are drawn where costs are rough, chosen
_IDLE = 3  # generations in a row without a better one after which no more are drawn, chosen
_SHAKEN, _LEAST_SHAKEN = 0.3, 0.01  # scales that they spread over, at first and at least, chosen
_FAR = 3.0  # the same of the values of effects alone, at first


def look_about(fitter: Fitter, fit: Fit, names: Collection[str], *, iterations: int = 2) -> Fit:
  """Returns a fit from near other latencies where that is better: held commands make stairs of
  them, in which steps end.

  Args:
    fitter: of the hypothesis.
    fit: where steps have ended.
    names: of the latencies and rates to shift.
    iterations: Jacobians at most of the fit from the best shifted values.
  """
  layout = fitter.layout
  kinds = [n for t in layout.terms for n in t.names]
  moved = [at for at, name in enumerate(kinds) if name in names]
  if not moved:
    return fit
  ends = max(log.time[-1] - log.time[0] for j in fitter.joints for log in j.plant.logs)
  by = np.diag([1.0 / ends if name == "rate" else 1.0 for name in kinds])
  tried = fit.x + np.array([s * by[at] for at in moved for s in _SHIFTS])
  tried = np.clip(tried, layout.low, layout.high)
  costs, rows = fitter.simulated(tried)
  k = int(np.argmin(costs))
  begin = fitter.weighed(tried[k], [row[k] for row in rows], fit.jacobian, None)
  other = fitter.fit(begin, iterations=iterations)
  return other if other.cost < fit.cost - _WORTH else fit


def draw(fitter: Fitter, fit: Fit) -> Fit:
  """Returns a better fit where costs are too rough for derivatives.

  Values are drawn about the best so far (cross-entropy method, Rubinstein 1999), those of effects
  from far about first.
  """
  random, layout = np.random.default_rng(0), fitter.layout
  best, least = fit.x, fit.cost
  for moving, shaken in ((layout.is_effect, _FAR), (np.ones(len(fit.x), bool), _SHAKEN)):
    mean, spread = best.copy(), shaken * layout.scale * moving
    since = 0  # generations that brought nothing
    for _ in range(_GENERATIONS):
      if since == _IDLE:
        break
      tried = random.normal(mean, spread, (_DRAWN, len(mean)))
      tried = np.clip(np.vstack([best, tried]), layout.low, layout.high)
      costs = fitter.costs(tried)
      elite = tried[np.argsort(costs)[:_ELITE]]
      since = 0 if costs.min() < least - _WORTH else since + 1
      best, least = elite[0], float(costs.min())
      narrow = _LEAST_SHAKEN * layout.scale * moving
      mean, spread = elite.mean(axis=0), np.maximum(elite.std(axis=0), narrow)
  return fitter.linearise(best, FINE) if least < fit.cost else fit
