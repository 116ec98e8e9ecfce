"""Posterior mode of a hypothesis by Gauss-Newton steps, and predictions of what was left out.

The negative log posterior, in nats,

    C(x) = sum over joints and blocks of n_b log(1 + m_b(x) / s^2) + 1/2 sum ((x - c) / sigma)^2

is minimised with the weights w_b = n_b / (N_b (s^2 + m_b)) held over a step. Simulations are what a
fit costs, and a Jacobian takes one a value: between Jacobians of finite differences steps carry it
along by what they found (Broyden 1965), and a new scale s needs no simulation at all. Left-out logs
are predicted by one further step from the mode without their share of gradient and curvature (the
infinitesimal jackknife). Shapes: n values, C channels, N samples, B blocks, X sets of values.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.layout import Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood

Array = np.ndarray

_DAMPINGS = (
  (1e-4, 1.0, True),
  (1e-4, 1.0, False),
  (1e-2, 0.3, True),
  (1e-2, 0.3, False),
  (3.0, 1.0, True),
)
"""Damping and share of the steps that are tried, and whether latencies move: held commands make
stairs of them, whose derivatives mislead."""
_FIRST = 2  # steps that are tried first; the others where these gain less than expected
_AS_EXPECTED = 0.5  # share of the gain that the linearisation promises, chosen
_CARRIED = 3  # steps at most between Jacobians of finite differences, chosen
_LEAST_CARRIED = 0.03  # scales that a step must be long to correct a Jacobian: costs are rough
_WIDTH, FINE = 0.2, 0.03  # steps of finite differences, of a value's scale
_CONVERGED = 0.05  # nats that a step gains at which a fit ends
_LEAST = 1e-3  # damping of steps by a part of the logs


class Fitter:
  """Fits hypotheses to the logs of some joints."""

  def __init__(self, joints: Sequence[JointLikelihood], layout: Layout):
    self.joints, self.layout = list(joints), layout
    self.folds = np.unique(np.concatenate([j.fold for j in joints]))

  def costs(self, xs: Array) -> Array:
    """Returns C of sets of values [X, n]."""
    return self.simulated(xs)[0]

  def simulated(self, xs: Array) -> tuple[Array, list[Array]]:
    """Returns C [X] and the residuals [X, C, N] a joint of sets of values [X, n]."""
    costs, rows = self.prior(xs), []
    for joint, terms, index in zip(
      self.joints, self.layout.of_joint, self.layout.index, strict=True
    ):
      rows.append(joint.residuals(terms, xs[:, index]))
      costs = costs - joint.loglik(joint.squares(rows[-1])).sum(axis=1)
    return costs, rows

  def prior(self, xs: Array) -> Array:
    """Returns the prior's part of C [X]."""
    return 0.5 * np.sum(((xs - self.layout.centre) / self.layout.sigma) ** 2, axis=1)

  def linearise(
    self,
    x: Array,
    width: float | Array = _WIDTH,
    known: list[Array] | None = None,
    fresh: Array | None = None,
    residuals: list[Array] | None = None,
  ) -> Fit:
    """Returns the linearisation at x.

    Args:
      x: values [n].
      width: of finite differences, of a value's scale; one for all or each [n].
      known: a Jacobian [n of the joint, C, N] a joint to take over; None for none.
      fresh: which values' columns are computed all the same [n] bool.
      residuals: at x [C, N] a joint; None to simulate them.
    """
    layout = self.layout
    steps = width * layout.scale
    steps = np.where((x + steps > layout.high) | (x + steps < layout.low), -steps, steps)
    here, jacobians = [], []
    for at, (joint, terms, index) in enumerate(
      zip(self.joints, layout.of_joint, layout.index, strict=True)
    ):
      own, new = x[index], np.arange(len(index))
      if known is not None and fresh is not None:
        new = np.flatnonzero(fresh[index])
      tried = own + np.diag(steps[index])[new]
      if residuals is None:
        both = joint.residuals(terms, np.vstack([own, tried]))
        first, rows = both[0], both[1:]
      else:
        first = residuals[at]
        rows = joint.residuals(terms, tried) if len(tried) else np.zeros((0, *first.shape))
      jacobian = np.empty((len(index), *first.shape))
      if known is not None:
        jacobian[:] = known[at]
      for k, row in zip(new, rows, strict=True):
        jacobian[k] = (row - first) / steps[index][k]
      here.append(first)
      jacobians.append(jacobian)
    return self.weighed(x, here, jacobians, width)

  def weighed(
    self, x: Array, residuals: list[Array], jacobian: list[Array], width: float | Array | None
  ) -> Fit:
    """Returns a fit of these residuals and derivatives under the joints' present scales."""
    layout, n = self.layout, self.layout.count
    curvature, gradient = np.zeros((len(self.folds), n, n)), np.zeros((len(self.folds), n))
    cost = float(self.prior(x[None])[0])
    for joint, index, rows, columns in zip(
      self.joints, layout.index, residuals, jacobian, strict=True
    ):
      squares = joint.squares(rows)
      cost -= float(joint.loglik(squares).sum())
      weights = 2.0 * joint.weights(squares)
      for f, fold in enumerate(self.folds):
        for part in joint.parts_of(fold):
          for row, weight, column in zip(rows, weights, columns.swapaxes(0, 1), strict=True):
            j = column[:, part]
            wj = j * weight[part]
            curvature[f][np.ix_(index, index)] += wj @ j.T
            gradient[f][index] += wj @ row[part]
    return Fit(layout, x, cost, residuals, curvature, gradient, jacobian, width)

  def again(self, fit: Fit) -> Fit:
    """Returns a fit under the joints' present scales."""
    return self.weighed(fit.x, fit.residuals, fit.jacobian, fit.width)

  def fit(
    self,
    start: Array | Fit,
    *,
    iterations: int,
    known: list[Array] | None = None,
    fresh: Array | None = None,
    quick: bool = False,
  ) -> Fit:
    """Returns the mode that Gauss-Newton steps with damping reach.

    Args:
      start: values [n], or a fit, whose derivatives are taken over.
      iterations: Jacobians at most, beside the first; steps at most where it is quick.
      known: a Jacobian to take over; see `linearise`.
      fresh: see `linearise`.
      quick: whether no further Jacobian is computed.
    """
    if isinstance(start, Fit):
      best = self.again(start)
    else:
      best = self.linearise(np.clip(start, self.layout.low, self.layout.high), _WIDTH, known, fresh)
    for _ in range(iterations if len(best.x) else 0):
      begun, best = best, self._descended(best, quick)
      if quick:
        continue
      if best is begun and best.width is not None and np.all(best.width <= FINE):
        break
      # Friction and held commands are rough: from coarse to fine.
      known = best.jacobian if known is not None else None
      best = self.linearise(best.x, FINE, known, fresh, best.residuals)
    return best

  def _descended(self, fit: Fit, quick: bool) -> Fit:
    """Returns a fit after steps that gain, with its Jacobian carried along."""
    for _ in range(1 if quick else _CARRIED):
      better = self._stepped(fit, quick)
      if better is None:
        break
      fit = better
    return fit

  def _stepped(self, fit: Fit, quick: bool) -> Fit | None:
    """Returns a fit after the step that gains most; None where none gains."""
    possible = self.promised(fit)
    if possible < _CONVERGED:
      return None
    steps = np.array([self._step(fit, *d) for d in _DAMPINGS])
    gained, found = _CONVERGED, None
    for tried in (steps[:_FIRST], steps[_FIRST:]):
      if quick and found is not None:
        break
      costs, rows = self.simulated(tried)
      k = int(np.argmin(costs))
      if fit.cost - costs[k] > gained:
        gained, found = fit.cost - costs[k], (tried[k], [row[k] for row in rows])
      if gained > _AS_EXPECTED * possible:
        break
    if found is None:
      return None
    return self.weighed(*found, self._carried(fit, *found), None)

  def promised(self, fit: Fit) -> float:
    """Returns the nats that a full step from a fit gains by its own linearisation."""
    by = self._step(fit, *_DAMPINGS[0]) - fit.x
    return -float(fit.slope @ by + 0.5 * by @ fit.precision @ by)

  def _carried(self, fit: Fit, x: Array, residuals: list[Array]) -> list[Array]:
    """Returns the Jacobian that also tells what a step from a fit has changed (Broyden 1965)."""
    result = []
    for index, jacobian, before, after in zip(
      self.layout.index, fit.jacobian, fit.residuals, residuals, strict=True
    ):
      scale = self.layout.scale[index]
      by = (x - fit.x)[index] / scale
      if float(by @ by) > _LEAST_CARRIED**2:
        missed = after - before - np.tensordot(by * scale, jacobian, 1)
        jacobian = jacobian + (by / (by @ by) / scale)[:, None, None] * missed
      result.append(jacobian)
    return result

  def _step(self, fit: Fit, damping: float, share: float, clocks: bool) -> Array:
    moving = None if clocks else np.flatnonzero(~self.layout.is_clock)
    return _bounded(fit.x, fit.precision, fit.slope, self.layout, damping, share, moving)

  def leave_out(self, fit: Fit) -> Fit:
    """Fills in what a fit predicts of each fold when its effects are fitted to the others alone.

    The constants stay: all hypotheses have them. Two steps are simulated, both with the fit's own
    Jacobian. Where neither is better for the others, as costs are rough, what that Jacobian lets
    expect of the first step stands: the fit itself has seen what is left out.
    """
    moving = np.flatnonzero(self.layout.is_effect)
    fit.held = [j.squares(r) for j, r in zip(self.joints, fit.residuals, strict=True)]
    if not len(moving) or len(self.folds) < 2:
      return fit
    within = [held.copy() for held in fit.held]
    first = np.array([self._without(fit, f, moving) for f in range(len(self.folds))])
    _, rows = self.simulated(first)
    here = [self._of_others(fit.x, within, fold) for fold in self.folds]
    second: list[Array] = []
    tried: list[list[tuple[float, list[Array]]]] = []
    for f, fold in enumerate(self.folds):
      own = [r[f] for r in rows]
      squares = [j.squares(r) for j, r in zip(self.joints, own, strict=True)]
      cost = self._of_others(first[f], squares, fold)
      tried.append([(cost, squares)])
      if cost < here[f]:
        second.append(self._without(self.weighed(first[f], own, fit.jacobian, None), f, moving))
      else:
        second.append(0.5 * (fit.x + first[f]))
    _, rows = self.simulated(np.array(second))
    for f, fold in enumerate(self.folds):
      squares = [j.squares(r[f]) for j, r in zip(self.joints, rows, strict=True)]
      tried[f].append((self._of_others(second[f], squares, fold), squares))
      cost, squares = min(tried[f], key=lambda t: t[0])
      if cost >= here[f]:
        squares = self._expected(fit, first[f])
      for joint, out, found in zip(self.joints, fit.held, squares, strict=True):
        out[:, joint.fold == fold] = found[:, joint.fold == fold]
    return fit

  def _expected(self, fit: Fit, x: Array) -> list[Array]:
    """Returns the mean squares [C, B] a joint at values [n] near a fit, by its Jacobian."""
    return [
      joint.squares(rows + np.tensordot((x - fit.x)[index], jacobian, 1))
      for joint, rows, index, jacobian in zip(
        self.joints, fit.residuals, self.layout.index, fit.jacobian, strict=True
      )
    ]

  def _without(self, fit: Fit, f: int, moving: Array) -> Array:
    """Returns a step [n] of the moving values from a fit by all folds but the f-th."""
    slope, precision = fit.slope - fit.gradient[f], fit.precision - fit.curvature[f]
    return _bounded(fit.x, precision, slope, self.layout, _LEAST, 1.0, moving)

  def _of_others(self, x: Array, squares: Sequence[Array], fold: int) -> float:
    """Returns C of values [n] without a fold; they leave mean squares [C, B] a joint."""
    cost = float(self.prior(x[None])[0])
    for joint, left in zip(self.joints, squares, strict=True):
      cost -= float(joint.loglik(left)[joint.fold != fold].sum())
    return cost


def _bounded(
  x: Array,
  h: Array,
  g: Array,
  layout: Layout,
  damping: float,
  share: float,
  moving: Array | None = None,
) -> Array:
  """Returns a damped Newton step from x, within bounds; values that press on one stay.

  Args:
    x: values [n].
    h: curvature [n, n].
    g: gradient [n].
    layout: bounds and scales.
    damping: of Marquardt's kind.
    share: of the step.
    moving: indices of the values that may move; all for None.
  """
  s = layout.scale
  free = ~(((x <= layout.low + 1e-9 * s) & (g > 0)) | ((x >= layout.high - 1e-9 * s) & (g < 0)))
  if moving is not None:
    free &= np.isin(np.arange(len(x)), moving)
  result = x.copy()
  if free.any():
    block = (h * s[:, None] * s)[np.ix_(free, free)]
    block = block + (1e-9 * np.trace(block) + 1e-9) * np.eye(len(block))
    block += damping * np.diag(np.diag(block))
    result[free] -= share * np.linalg.solve(block, (g * s)[free]) * s[free]
  return np.clip(result, layout.low, layout.high)
