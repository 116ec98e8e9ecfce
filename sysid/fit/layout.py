"""Values of a hypothesis of some joints: whose they are, bounds and priors, and a fit of them.

Shapes: n values, C channels, N samples, B blocks, F folds.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.hypotheses.terms import Term

Array = np.ndarray

CONSTANTS = "calibration"
CLOCKS = ("latency", "skew", "delay")


class Layout:
  """Which values are whose: shared terms first, then each joint's own."""

  def __init__(self, own: Sequence[Sequence[Term]], shared: Sequence[Term] = ()):
    self.terms: list[Term] = [*shared, *[t for o in own for t in o]]
    at, spans = 0, []
    for term in self.terms:
      spans.append((at, at + len(term.names)))
      at += len(term.names)
    self.spans, self.count = spans, at
    first = len(shared)
    common = [i for a, b in spans[:first] for i in range(a, b)]
    self.index: list[Array] = []
    self.of_joint: list[tuple[Term, ...]] = []
    for terms in own:
      mine = [i for a, b in spans[first : first + len(terms)] for i in range(a, b)]
      first += len(terms)
      self.index.append(np.array(mine + common, int))
      self.of_joint.append((*terms, *shared))
    join = lambda f: np.concatenate([np.zeros(0), *[np.array(f(t), float) for t in self.terms]])  # noqa: E731
    self.low, self.high = join(lambda t: t.low), join(lambda t: t.high)
    self.scale = join(lambda t: t.scale)
    self.sigma = join(lambda t: t.prior or (np.inf,) * len(t.names))
    self.centre = join(lambda t: t.centre or (0.0,) * len(t.names))
    self.open = np.zeros((at, at))
    for term, (a, b) in zip(self.terms, spans, strict=True):
      if term.open:
        self.open[a:b, a:b] = term.open
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
  width: float | Array | None = None
  """Of the finite differences that the Jacobian is of; None where it was carried along by steps."""
  held: list[Array] = dataclasses.field(default_factory=list)
  """Mean squares [C, B] of left-out blocks, a joint."""
  spread: tuple[bytes, Array] | None = None
  """Covariance [n, n], and the residual's scale under which it holds."""

  def values(self, term: Term) -> dict[str, float]:
    """Returns the values of a term by name."""
    a, b = self.layout.spans[self.layout.terms.index(term)]
    return dict(zip(term.names, map(float, self.x[a:b]), strict=True))

  @property
  def precision(self) -> Array:
    """Curvature of the posterior [n, n]."""
    return self.curvature.sum(axis=0) + np.diag(self.layout.sigma**-2.0)

  @property
  def slope(self) -> Array:
    """Gradient of the negative log posterior [n]."""
    return self.gradient.sum(axis=0) + (self.x - self.layout.centre) / self.layout.sigma**2
