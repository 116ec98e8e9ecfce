"""Fits hypotheses to logs: least squares on positions and efforts, several starts.

Residuals are divided by the noise of their channel. Levenberg-Marquardt on the normal equations:
scipy's trust-region solver factorises the whole Jacobian (10 000 residuals) at every step, which
took as long as all simulations together, and tries one damping at a time.

Shapes: n values of a hypothesis, R residuals.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.noise import position_noise
from nerf2real.sysid.hypotheses.terms import Term, compose
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import quantum
from nerf2real.sysid.model.plant import JointPlant, Output

Array = np.ndarray

_DIFFERENCES = (0.004, 0.024)
"""Steps of finite differences, of a value's scale: from fine to coarse, as friction is rough."""
_ROUGH = ("backlash",)
_ROUGH_DIFFERENCES = (0.144, 0.024)
"""The same of kinds whose courses do not repeat: from coarse to fine; ours."""
_DAMPINGS = ((1e-6, 1.0), (1e-6, 0.3), (1e-6, 0.08), (1e-3, 1.0), (0.1, 1.0), (3.0, 1.0))
"""Dampings and shares of the step that are tried side by side."""
_CONVERGED = 1e-4  # relative gain of a step at which a fit ends
_THOROUGH = 20  # evaluations from which a fit that ended looks about before it stays
_LOOKS = 3  # times it does so
_GENERATIONS, _DRAWN, _ELITE = 12, 40, 8  # of values that are drawn where costs are rough; ours
_SHAKEN, _LEAST_SHAKEN = 0.3, 0.01  # scales that they spread over, at first and at least; ours
_SIZES = (0.4, 0.7, 1.4, 2.5)  # times a size that is looked at
_MOVES = (-3.0, -1.0, 1.0, 3.0)  # scales about a value that may be negative
_SOFT = 4.0  # noise units; larger residuals count linearly
PRIOR_COUNT = 25.0  # residuals that one independent observation is spread over; ours


@dataclasses.dataclass(frozen=True)
class Fit:
  """A fitted hypothesis of one joint."""

  terms: tuple[Term, ...]
  x: Array
  """[n]."""
  cost: float
  effort_scale: float
  evaluations: int

  def part(self, index: int) -> Array:
    """Returns the values of one term."""
    at = sum(len(term.names) for term in self.terms[:index])
    return self.x[at : at + len(self.terms[index].names)]

  def values(self, kind: str) -> dict[str, float]:
    """Returns the values of the term of a kind, by name; empty if it has none."""
    for index, term in enumerate(self.terms):
      if term.kind == kind:
        return dict(zip(term.names, map(float, self.part(index)), strict=True))
    return {}

  def at_bound(self, kind: str) -> bool:
    """Tells whether a value of the term of that kind ended on a bound that is not its zero."""
    for index, term in enumerate(self.terms):
      if term.kind != kind:
        continue
      for value, low, high in zip(self.part(index), term.low, term.high, strict=True):
        width = high - low
        if value > high - 1e-3 * width or (value < low + 1e-3 * width and low != 0.0):
          return True
    return False


class Problem:
  """The logs of one joint with the noise of their channels: turns hypotheses into residuals."""

  def __init__(self, plant: JointPlant, *, masks: Sequence[Array] | None = None):
    """Notes noise levels.

    Args:
      plant: the joint.
      masks: [N] bool a log: which samples count; all for None.
    """
    self.plant = plant
    logs = plant.logs
    self.masks = [log.valid.copy() for log in logs]
    if masks is not None:
      self.masks = [a & b for a, b in zip(self.masks, masks, strict=True)]
    self.position_noise = position_noise(plant)
    self.channel = "effort"
    if any(log.effort is None for log in logs):
      self.channel = "duty" if all(log.duty is not None for log in logs) else "none"
    self.effort_noise = self._effort_noise()

  def masked(self, masks: Sequence[Array]) -> "Problem":
    """Returns the same problem on part of the samples."""
    return Problem(self.plant, masks=masks)

  def following(self) -> "Problem":
    """Returns the same problem with the state pulled towards the readings; see `JointPlant`."""
    return Problem(self.plant.following(), masks=self.masks)

  def _effort_noise(self) -> float:
    if self.channel == "none":
      return 1.0
    steps = [quantum(self.effort(i)) for i in range(len(self.plant.logs))]
    jitter = [
      float(np.median(np.abs(np.diff(self.effort(i), n=2)))) / 1.65
      for i in range(len(self.plant.logs))
    ]
    return max(*steps, float(np.median(jitter)), 1e-9)

  def effort(self, index: int) -> Array:
    """Returns the measured effort, or duty, of a log [N]."""
    log = self.plant.logs[index]
    values = log.effort if self.channel == "effort" else log.duty
    assert values is not None
    return values

  def simulate(self, terms: Sequence[Term], xs: Array) -> list[list[Output]]:
    """Returns the motion of each set of values [B, n]."""
    composed = [compose(self.plant, terms, x) for x in np.atleast_2d(xs)]
    return self.plant.simulate(
      np.array([p for p, _ in composed]), surroundings=[s for _, s in composed]
    )

  def effort_scale(self, outputs: Sequence[Output]) -> float:
    """Returns measured effort over simulated torque.

    Both are scaled by least squares over all logs: an effort's torque constant is a guess, and full
    duty is the torque limit of the model only about, where it has one.
    """
    if self.channel == "none":
      return 1.0
    full = float(self.plant.declared[INDEX["highest"]])
    above, below = 0.0, 1e-12
    for index, output in enumerate(outputs):
      torque = output.torque
      chosen = self.masks[index] & (output.jump < 10 * self.effort_noise)
      above += float(self.effort(index)[chosen] @ torque[chosen])
      below += float(torque[chosen] @ torque[chosen])
    scale = above / below
    if self.channel == "effort":
      return float(np.clip(scale, 0.3, 3.0))
    return float(np.clip(scale, 0.3 / full, 3.0 / full)) if np.isfinite(full) else float(scale)

  def errors(self, outputs: Sequence[Output]) -> list[tuple[Array, Array | None]]:
    """Returns measured minus simulated position and effort of each log, in noise units."""
    scale = self.effort_scale(outputs)
    result: list[tuple[Array, Array | None]] = []
    for index, output in enumerate(outputs):
      log = self.plant.logs[index]
      along = (log.position - output.position) / self.position_noise
      effort = None
      if self.channel != "none":
        noise = np.hypot(self.effort_noise, abs(scale) * output.jump)
        effort = (self.effort(index) - scale * output.torque) / noise
      result.append((along, effort))
    return result

  def residuals(self, terms: Sequence[Term], xs: Array) -> Array:
    """Returns soft residuals [B, R] of sets of values, priors included."""
    xs = np.atleast_2d(xs)
    rows = []
    for x, outputs in zip(xs, self.simulate(terms, xs), strict=True):
      parts = []
      for index, (along, effort) in enumerate(self.errors(outputs)):
        chosen = self.masks[index]
        parts.append(soft(along[chosen]))
        if effort is not None:
          parts.append(0.5 * soft(effort[chosen]))
      parts.append(_prior(terms, x))
      rows.append(np.concatenate(parts))
    return np.array(rows)

  def fit(self, terms: Sequence[Term], start: Array | None = None, *, evaluations: int = 25) -> Fit:
    """Fits a hypothesis, from every combination of its terms' starts or from one start [n]."""
    low = np.concatenate([np.zeros(0), *[term.low for term in terms]])
    high = np.concatenate([np.zeros(0), *[term.high for term in terms]])
    scale = np.concatenate([np.zeros(0), *[term.scale for term in terms]])
    starts = [start] if start is not None else self._starts(terms)
    starts = [np.clip(s, low + 1e-9 * scale, high - 1e-9 * scale) for s in starts]
    if len(starts) > 2:  # look at all, descend from the best two
      costs = np.sum(self.residuals(terms, np.array(starts)) ** 2, axis=1)
      starts = [starts[i] for i in np.argsort(costs)[:2]]
    fits = [self._descend(terms, begin, low, high, scale, evaluations) for begin in starts]
    best = min(fits, key=lambda fit: fit.cost)
    for _ in range(_LOOKS if evaluations >= _THOROUGH else 0):
      begin = self._look_about(best, low, high, scale)
      if begin is None:
        break
      fit = self._descend(terms, begin, low, high, scale, evaluations)
      best = fit if fit.cost < best.cost else best
    if is_rough(terms) and evaluations >= _THOROUGH:
      best = self._shake(best, low, high, scale)
    return best

  def _shake(self, fit: Fit, low: Array, high: Array, scale: Array) -> Fit:
    """Returns a fit improved by the cross-entropy method (Rubinstein 1999).

    Where courses do not repeat, the cost is too rough for derivatives of any width.
    """
    random = np.random.default_rng(0)
    mean, spread = fit.x.copy(), _SHAKEN * scale
    best, cost = fit.x, fit.cost
    for _ in range(_GENERATIONS):
      drawn = np.clip(random.normal(mean, spread, (_DRAWN, len(mean))), low, high)
      costs = 0.5 * np.sum(np.square(self.residuals(fit.terms, drawn)), axis=1)
      order = np.argsort(costs)
      if costs[order[0]] < cost:
        best, cost = drawn[order[0]], float(costs[order[0]])
      elite = np.vstack([best, drawn[order[:_ELITE]]])
      mean, spread = elite.mean(axis=0), elite.std(axis=0) + _LEAST_SHAKEN * scale
    scale_of = self.effort_scale(self.simulate(fit.terms, best)[0])
    return Fit(fit.terms, best, cost, scale_of, fit.evaluations)

  def _look_about(self, fit: Fit, low: Array, high: Array, scale: Array) -> Array | None:
    """Returns values with one effect's value moved far that cost less, None if there are none.

    Sticking and play make valleys in which a descent ends early.
    """
    tried, at = [], 0
    for term in fit.terms:
      for j in range(at, at + len(term.names)):
        if term.kind == "calibration":
          continue
        moved = (
          fit.x[j] * np.array(_SIZES) if low[j] >= 0 else fit.x[j] + scale[j] * np.array(_MOVES)
        )
        for value in np.clip(moved, low[j], high[j]):
          tried.append(fit.x.copy())
          tried[-1][j] = value
      at += len(term.names)
    if not tried:
      return None
    costs = 0.5 * np.sum(np.square(self.residuals(fit.terms, np.array(tried))), axis=1)
    best = int(np.argmin(costs))
    return tried[best] if costs[best] < (1.0 - _CONVERGED) * fit.cost else None

  def _starts(self, terms: Sequence[Term]) -> list[Array]:
    starts = [np.zeros(0)]
    for term in terms:
      starts = [np.concatenate([s, np.array(t, float)]) for s in starts for t in term.starts]
    return starts

  def _descend(
    self, terms: Sequence[Term], start: Array, low: Array, high: Array, scale: Array, limit: int
  ) -> Fit:
    """Levenberg-Marquardt with bounds; several dampings are tried side by side."""
    x, count, cost = start, 0, float("inf")
    widths = [width * scale for width in differences(terms)]
    steps = widths.pop(0)
    while count < limit:
      signed = np.where(x + steps > high, -steps, steps)
      rows = self.residuals(terms, np.vstack([x, x + np.diag(signed)]))
      cost = 0.5 * float(rows[0] @ rows[0])
      count += 1
      if not len(x):
        break
      jacobian = (rows[1:] - rows[0]) / steps_column(signed, scale)
      normal, gradient = jacobian @ jacobian.T, jacobian @ rows[0]
      normal += 1e-12 * np.trace(normal) * np.eye(len(x))
      free = ~(((x <= low + 1e-9 * scale) & (gradient > 0)) | ((x >= high) & (gradient < 0)))
      tried = np.repeat(x[None], len(_DAMPINGS), axis=0)
      for row, (damping, share) in zip(tried, _DAMPINGS, strict=True):
        block = normal[np.ix_(free, free)]
        damped = block + damping * np.diag(np.diag(block))
        row[free] -= share * np.linalg.solve(damped, gradient[free]) * scale[free]
        np.clip(row, low, high, out=row)
      values = self.residuals(terms, tried)
      costs = 0.5 * np.sum(np.square(values), axis=1)
      best = int(np.argmin(costs))
      gained = cost - costs[best]
      if gained > 0:
        x, cost = tried[best], float(costs[best])
      if gained < _CONVERGED * cost:
        if not widths:
          break
        steps = widths.pop(0)
    outputs = self.simulate(terms, x)[0]
    return Fit(tuple(terms), x, cost, self.effort_scale(outputs), count)


def is_rough(terms: Sequence[Term]) -> bool:
  """Tells whether a hypothesis has a kind whose courses do not repeat."""
  return any(term.kind in _ROUGH for term in terms)


def differences(terms: Sequence[Term]) -> tuple[float, float]:
  """Returns the steps of finite differences of a hypothesis, of its values' scales: the second is
  taken where the first leads nowhere."""
  return _ROUGH_DIFFERENCES if is_rough(terms) else _DIFFERENCES


def steps_column(steps: Array, scale: Array) -> Array:
  """Returns the steps in units of the scale as a column [n, 1]."""
  return (steps / scale)[:, None]


def soft(values: Array) -> Array:
  """Returns residuals whose squares grow linearly beyond a few noise units (pseudo-Huber)."""
  return np.sign(values) * _SOFT * np.sqrt(2.0 * (np.sqrt(1.0 + (values / _SOFT) ** 2) - 1.0))


def _prior(terms: Sequence[Term], x: Array) -> Array:
  rows, at = [], 0
  for term in terms:
    part = x[at : at + len(term.names)]
    at += len(term.names)
    if term.prior:
      centre = np.array(term.centre) if term.centre else 0.0
      rows.append((part - centre) / np.array(term.prior) * np.sqrt(PRIOR_COUNT))
  return np.concatenate(rows) if rows else np.zeros(0)
