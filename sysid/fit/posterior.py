"""Posterior mode of a hypothesis by Gauss-Newton steps, and predictions of what was left out.

The negative log posterior, in nats,

    C(x) = sum over joints and blocks of n_b log(1 + m_b(x) / s^2) + 1/2 sum ((x - c) / sigma)^2

is minimised with the weights w_b = n_b / (N_b (s^2 + m_b)) held over a step. Left-out logs are
predicted by one further step from the mode without their share of gradient and curvature (the
infinitesimal jackknife). Shapes: n values, C channels, N samples, B blocks.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term

Array = np.ndarray

CONSTANTS = "calibration"
CLOCKS = ("latency", "skew", "delay")
_DAMPINGS = (
  (1e-4, 1.0, True),
  (1e-4, 1.0, False),
  (1e-2, 0.3, True),
  (1e-2, 0.3, False),
  (3.0, 1.0, True),
)
"""Damping and share of the steps that are tried, and whether latencies move: held commands make
stairs of them, whose derivatives mislead."""
_WIDTH, _FINE = 0.2, 0.03  # steps of finite differences, of a value's scale
_GENERATIONS, _DRAWN, _ELITE = 12, 40, 8  # of values that are drawn where costs are rough, chosen
_SHAKEN, _LEAST_SHAKEN = 0.3, 0.01  # scales that they spread over, at first and at least, chosen
_CONVERGED = 0.05  # nats that a step gains at which a fit ends


class Layout:
  """Which values are whose: shared terms first, then each joint's own."""

  def __init__(self, own: Sequence[Sequence[Term]], shared: Sequence[Term] = ()):
    self.own, self.shared = [tuple(o) for o in own], tuple(shared)
    self.terms: list[Term] = [*shared, *[t for o in own for t in o]]
    at, spans = 0, []
    for term in self.terms:
      spans.append((at, at + len(term.names)))
      at += len(term.names)
    self.spans, self.count = spans, at
    first = len(self.shared)
    common = [i for a, b in spans[:first] for i in range(a, b)]
    self.index: list[Array] = []
    self.of_joint: list[tuple[Term, ...]] = []
    for terms in self.own:
      mine = [i for a, b in spans[first : first + len(terms)] for i in range(a, b)]
      first += len(terms)
      self.index.append(np.array(mine + common, int))
      self.of_joint.append((*terms, *self.shared))
    join = lambda f: np.concatenate([np.zeros(0), *[np.array(f(t), float) for t in self.terms]])  # noqa: E731
    self.low, self.high = join(lambda t: t.low), join(lambda t: t.high)
    self.scale = join(lambda t: t.scale)
    self.sigma = join(lambda t: t.prior or (np.inf,) * len(t.names))
    self.centre = join(lambda t: t.centre or (0.0,) * len(t.names))
    self.is_clock = np.array([n in CLOCKS for t in self.terms for n in t.names], bool)
    self.is_effect = join(lambda t: (t.freed or t.kind != CONSTANTS,) * len(t.names)).astype(bool)


@dataclasses.dataclass
class Fit:
  """A hypothesis at its posterior mode."""

  layout: Layout
  x: Array
  cost: float
  residuals: list[Array]
  """[C, N] a joint."""
  curvature: Array
  """[F, n, n] a fold, of the likelihood."""
  gradient: Array
  """[F, n]."""
  jacobian: list[Array]
  """[n of the joint, C, N] a joint."""
  held: list[Array] = dataclasses.field(default_factory=list)
  """Mean squares [C, B] of left-out blocks, a joint."""
  held_x: list[Array] = dataclasses.field(default_factory=list)
  """Values without each fold."""

  def values(self, term: Term) -> dict[str, float]:
    """Returns the values of a term by name."""
    a, b = self.layout.spans[self.layout.terms.index(term)]
    return dict(zip(term.names, map(float, self.x[a:b]), strict=True))

  @property
  def precision(self) -> Array:
    """Curvature of the posterior [n, n]."""
    return self.curvature.sum(axis=0) + np.diag(self.layout.sigma**-2.0)


class Fitter:
  """Fits hypotheses to the logs of some joints."""

  def __init__(self, joints: Sequence[JointLikelihood], layout: Layout):
    self.joints, self.layout = list(joints), layout
    self.folds = np.unique(np.concatenate([j.fold for j in joints]))

  def costs(self, xs: Array, *, without: int | None = None) -> Array:
    """Returns C of sets of values [X, n], of all but one fold."""
    total = self.prior(xs)
    for joint, terms, index in zip(
      self.joints, self.layout.of_joint, self.layout.index, strict=True
    ):
      nats = joint.loglik(joint.squares(joint.residuals(terms, xs[:, index])))
      keep = np.ones(nats.shape[1]) if without is None else (joint.fold != without)
      total = total - nats @ keep
    return total

  def prior(self, xs: Array) -> Array:
    """Returns the prior's part of C [X]."""
    return 0.5 * np.sum(((xs - self.layout.centre) / self.layout.sigma) ** 2, axis=1)

  def linearise(
    self, x: Array, width: float, known: list[Array] | None = None, fresh: Array | None = None
  ) -> Fit:
    """Returns the linearisation at x.

    Args:
      x: values [n].
      width: of finite differences, of a value's scale.
      known: a Jacobian [n of the joint, C, N] a joint to take over; None for none.
      fresh: which values' columns are computed all the same [n] bool.
    """
    layout, n = self.layout, self.layout.count
    curvature, gradient = np.zeros((len(self.folds), n, n)), np.zeros((len(self.folds), n))
    cost, residuals, jacobians = float(self.prior(x[None])[0]), [], []
    steps = width * layout.scale
    steps = np.where((x + steps > layout.high) | (x + steps < layout.low), -steps, steps)
    for at, (joint, terms, index) in enumerate(
      zip(self.joints, layout.of_joint, layout.index, strict=True)
    ):
      own = x[index]
      new = np.arange(len(index))
      if known is not None and fresh is not None:
        new = np.flatnonzero(fresh[index])
      rows = joint.residuals(terms, np.vstack([own, own + np.diag(steps[index])[new]]))
      jacobian = np.empty((len(index), *rows.shape[1:]))
      if known is not None:
        jacobian[:] = known[at]
      jacobian[new] = (rows[1:] - rows[0]) / steps[index][new][:, None, None]
      squares = joint.squares(rows[0])
      cost -= float(joint.loglik(squares).sum())
      weight = joint.weights(squares)
      sample_fold = joint.fold[joint.block_of]
      for f, fold in enumerate(self.folds):
        chosen = sample_fold == fold
        w, r = weight[:, chosen].ravel(), rows[0][:, chosen].ravel()
        j = jacobian[:, :, chosen].reshape(len(index), len(r))
        wj = j * w
        curvature[f][np.ix_(index, index)] += 2.0 * wj @ j.T
        gradient[f][index] += 2.0 * wj @ r
      residuals.append(rows[0])
      jacobians.append(jacobian)
    return Fit(layout, x, cost, residuals, curvature, gradient, jacobians)

  def fit(
    self,
    x: Array,
    *,
    iterations: int,
    width: float = _WIDTH,
    known: list[Array] | None = None,
    fresh: Array | None = None,
    quick: bool = False,
  ) -> Fit:
    """Returns the mode that Gauss-Newton steps with damping reach from x."""
    layout = self.layout
    x = np.clip(x, layout.low, layout.high)
    best = self.linearise(x, width, known, fresh)
    for _ in range(iterations if len(x) else 0):
      tried = np.array([self._step(best, *d) for d in (_DAMPINGS[:2] if quick else _DAMPINGS)])
      costs = self.costs(tried)
      k = int(np.argmin(costs))
      if costs[k] < best.cost - _CONVERGED:
        known = best.jacobian if known is not None else None
        best = self.linearise(tried[k], width, known, fresh)
      elif width > _FINE:  # friction and held commands are rough: from coarse to fine
        width = _FINE
        best = self.linearise(best.x, width, known, fresh)
      else:
        break
    return best

  def draw(self, fit: Fit) -> Fit:
    """Returns a better fit where costs are too rough for derivatives: values are drawn about the
    best so far (cross-entropy method, Rubinstein 1999)."""
    random, layout = np.random.default_rng(0), self.layout
    mean, spread = fit.x.copy(), _SHAKEN * layout.scale
    best, least = fit.x, fit.cost
    for _ in range(_GENERATIONS):
      tried = random.normal(mean, spread, (_DRAWN, len(mean)))
      tried = np.clip(np.vstack([best, tried]), layout.low, layout.high)
      costs = self.costs(tried)
      elite = tried[np.argsort(costs)[:_ELITE]]
      best, least = elite[0], float(costs.min())
      mean, spread = elite.mean(axis=0), np.maximum(elite.std(axis=0), _LEAST_SHAKEN * layout.scale)
    return self.linearise(best, _FINE) if least < fit.cost else fit

  def _step(self, fit: Fit, damping: float, share: float, clocks: bool) -> Array:
    layout = self.layout
    moving = None if clocks else np.flatnonzero(~layout.is_clock)
    g = fit.gradient.sum(axis=0) + (fit.x - layout.centre) / layout.sigma**2
    return _bounded(fit.x, fit.precision, g, layout, damping, share, moving)

  def leave_out(self, fit: Fit) -> Fit:
    """Fills in what a fit predicts of each fold when its effects are fitted to the others alone.

    The constants stay: all hypotheses have them.
    """
    layout, x = self.layout, fit.x
    moving = np.flatnonzero(layout.is_effect)
    fit.held = [j.squares(r) for j, r in zip(self.joints, fit.residuals, strict=True)]
    fit.held_x = [x] * len(self.folds)
    if not len(moving) or len(self.folds) < 2:
      return fit
    for f, fold in enumerate(self.folds):
      g = fit.gradient.sum(axis=0) - fit.gradient[f] + (x - layout.centre) / layout.sigma**2
      h = fit.precision - fit.curvature[f]
      tried = np.array([_bounded(x, h, g, layout, 1e-3, s, moving) for s in (1.0, 0.5)])
      rows = [
        joint.squares(joint.residuals(terms, tried[:, index]))
        for joint, terms, index in zip(self.joints, layout.of_joint, layout.index, strict=True)
      ]
      rows = [np.concatenate([r, h[None]]) for r, h in zip(rows, fit.held, strict=True)]
      costs = self.prior(np.vstack([tried, x]))
      for joint, squares in zip(self.joints, rows, strict=True):
        costs = costs - joint.loglik(squares)[:, joint.fold != fold].sum(axis=1)
      best = int(np.argmin(costs))
      fit.held_x[f] = np.vstack([tried, x])[best]
      for joint, squares, out in zip(self.joints, rows, fit.held, strict=True):
        out[:, joint.fold == fold] = squares[best][:, joint.fold == fold]
    return fit


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


def deviations(fit: Fit, joints: Sequence[JointLikelihood], *, systematic: float = 1.0) -> Array:
  """Returns the standard deviations [n] of a fit's values, by the gradient's scatter over blocks.

  H^-1 (sum over blocks of g g') H^-1, which holds where residuals go together (White 1980, in
  blocks as Liang and Zeger 1986); blocks of different joints at the same time are added.

  Args:
    fit: at its mode.
    joints: what was fitted.
    systematic: factor on the scatter of blocks; priors count with the spread that they state.
  """
  scores = np.zeros((len(joints[0].starts), fit.layout.count))
  for joint, index, residual, jacobian in zip(
    joints, fit.layout.index, fit.residuals, fit.jacobian, strict=True
  ):
    weighted = 2.0 * joint.weights(joint.squares(residual)) * residual * jacobian
    scores[:, index] += np.add.reduceat(weighted, joint.starts, axis=-1).sum(axis=1).T
  inverse = np.linalg.pinv(fit.precision, rcond=1e-12)
  prior = np.diag(fit.layout.sigma**-2.0)
  return np.sqrt(
    np.maximum(np.diag(inverse @ (systematic**2 * scores.T @ scores + prior) @ inverse), 0.0)
  )
