"""How sure the values of a fit are: a sandwich estimate that allows for correlated residuals.

    covariance = H^-1 (sum over blocks of g g') H^-1,  H = J'J,  g = J_b' r_b

with blocks much longer than the residuals' memory (White 1980; block form as in Liang and Zeger
1986), widened by a systematic share: a model that is slightly wrong moves its values by more than
noise does. Priors count with the spread that they state: a friction that was added cannot be known
better than the damping that was declared. Shapes: n values, R residuals of a block.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.fitting import PRIOR_COUNT, Fit, Problem, differences, is_rough
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.kernel import INDEX

Array = np.ndarray

BLOCK_S = 1.0  # s
SYSTEMATIC = 2.0  # factor on standard deviations; ours, set on blind sets to cover 95 %
RELATIVE = 0.009  # of a value; what no model of a joint holds: elastic gears, uneven teeth; ours
BESIDE_PLAY = 0.025  # the same where a course does not repeat; ours
PEAK = 0.08  # of friction at rest, which yields over a way no rigid model has; ours
LATE = 6e-4  # s of a delay; firmware and bus work in cycles of a millisecond; ours
OWN_LATENCY = 0.0025  # s; what a healthy machine may have of a delay that was found; ours
RUBS = 0.2  # of the declared dry friction; servos of one batch differ by that much; ours
_DRY = ("torque", "positive", "negative")  # dry friction that is added to the declared one
_PLAY = {"gap": (0.85, 1.35), "stiffness": (0.4, 2.5), "damping": (0.4, 2.5)}
"""Times a value of play, the least of an interval: gears that give way take a part of the gap, and
costs are too rough for derivatives to say how sure values are. Ours, on blind sets."""
_Z = 1.96


def covariance(problem: Problem, fit: Fit) -> Array:
  """Returns the covariance [n, n] of a fit's values, systematic share included."""
  terms = fit.terms
  scale = np.concatenate([np.zeros(0), *[t.scale for t in terms]])
  low = np.concatenate([np.zeros(0), *[t.low for t in terms]])
  high = np.concatenate([np.zeros(0), *[t.high for t in terms]])
  # Small (but with play) and central: where two values do the same (damping and added friction),
  # their derivatives must agree to a part in a thousand, or the difference looks like information.
  width = differences(terms)[0] * scale
  above, below = np.minimum(fit.x + width, high), np.maximum(fit.x - width, low)
  rows = problem.residuals(
    terms, np.vstack([fit.x, fit.x + np.diag(above - fit.x), fit.x + np.diag(below - fit.x)])
  )
  residual, count = rows[0], len(fit.x)
  jacobian = (rows[1 : count + 1] - rows[count + 1 :]) / (above - below)[:, None]
  priors = sum(len(t.prior) for t in terms)
  normal = jacobian @ jacobian.T
  fixed = (fit.x <= low + 1e-9 * scale) & (jacobian @ residual > 0)
  free = ~(fixed | (np.diag(normal) <= 0))
  meat = np.zeros_like(normal)
  for block in _blocks(problem, len(residual) - priors):
    g = jacobian[:, block] @ residual[block]
    meat += SYSTEMATIC**2 * np.outer(g, g)
  tail = jacobian[:, len(residual) - priors :]  # weighted by that count; see `fitting`
  meat += PRIOR_COUNT * tail @ tail.T
  result = np.zeros_like(normal)
  index = np.ix_(free, free)
  inverse = np.linalg.pinv(normal[index], rcond=1e-12)
  result[index] = inverse @ meat[index] @ inverse
  return result


def _blocks(problem: Problem, count: int) -> Sequence[Array]:
  """Returns index arrays of residuals that belong to the same second of the same log."""
  labels, offset = [], 0
  for log, mask in zip(problem.plant.logs, problem.masks, strict=True):
    block = np.floor((log.time[mask] - log.time[0]) / BLOCK_S).astype(int) + offset
    offset = int(block.max(initial=offset)) + 1
    labels += [block] if problem.channel == "none" else [block, block]
  joined = np.concatenate(labels)
  assert len(joined) == count
  order = np.argsort(joined, kind="stable")
  return np.split(order, np.flatnonzero(np.diff(joined[order])) + 1)


def intervals(problem: Problem, fit: Fit, kind: str) -> dict[str, tuple[float, float]]:
  """Returns 95 % intervals of the values of the term of a kind."""
  spread = np.sqrt(np.maximum(np.diag(covariance(problem, fit)), 0.0))
  result, at = {}, 0
  for term in fit.terms:
    if term.kind == kind:
      part = slice(at, at + len(term.names))
      dry = float(problem.plant.declared[INDEX["friction"]])
      alone = not fit.terms[0].centre
      share = BESIDE_PLAY if is_rough(fit.terms) else RELATIVE
      result = around(
        term, fit.x[part], spread[part], own_latency=alone, friction=dry, relative=share
      )
    at += len(term.names)
  return result


def around(
  term: Term,
  x: Array,
  spread: Array,
  *,
  own_latency: bool = False,
  friction: float = 0.0,
  relative: float = RELATIVE,
) -> dict[str, tuple[float, float]]:
  """Returns 95 % intervals about values of a term.

  Args:
    term: the effect.
    x: its values [n].
    spread: their standard deviations [n].
    own_latency: whether nothing tells what latency the machine had before: then a delay is all
      that it has now, and its interval reaches down by what healthy machines have.
    friction: the declared dry friction, N m or N.
    relative: share of a value that no model of the joint holds.
  """
  result = {}
  for name, value, sigma, lowest in zip(term.names, x, spread, term.low, strict=True):
    own = 1.0 + value if term.kind == "calibration" else value  # a factor is told
    known = LATE if name == "delay" else 0.0
    known = RUBS * friction if name in _DRY and term.kind != "calibration" else known
    share = PEAK if name == "breakaway" else relative
    reach = _Z * float(np.sqrt(sigma**2 + (share * own) ** 2 + known**2))
    below = OWN_LATENCY if name == "delay" and own_latency else 0.0
    low, high = max(value - reach - below, lowest), value + reach
    if term.kind == "backlash":
      low, high = min(low, _PLAY[name][0] * value), max(high, _PLAY[name][1] * value)
    result[name] = (float(low), float(high))
  return result
