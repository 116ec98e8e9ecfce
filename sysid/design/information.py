"""Fisher information of effects along motions, tolerances of the constants marginalised.

An effect at values where its search starts changes the readings by a secant s [C, N] (of thresholds
such as a torque limit derivatives at rest are zero). With the readings' noise f of every channel,
and derivatives by the nominal constants times their tolerances as A [C N, n],

    F = U' (I + A A')^-1 U,  u = s / (f sqrt(N))

so that F_aa = 1 where the change, less what constants within a tolerance imitate, has the size of
the noise in the mean square. What a rival J of any size leaves of it is the Schur complement

    F_a|J = F_aa - F_aJ F_JJ^+ F_Ja,  1 - F_a|J / F_aa = cos^2 of the angle between them

(Kay 1993, Fundamentals of Statistical Signal Processing I, section 3.7, on nuisance parameters;
Bjorck and Golub 1973 on angles between subspaces). Shapes: C channels, N samples, n constants,
K secants.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term

Array = np.ndarray

Readings = Callable[[Sequence[Term], Array], Array]
"""Returns simulated readings or residuals [C, N] of terms with values."""

_FLAT = 1e-9
"""Of a rival's largest information: directions with less are no direction of their own."""


@dataclasses.dataclass(frozen=True)
class Place:
  """An effect at certain values: one secant."""

  term: Term
  start: tuple[float, ...]

  @property
  def kind(self) -> str:
    """Its kind."""
    return self.term.kind

  def sizes(self, share: float = 1.0) -> dict[str, float]:
    """Returns the values that turn the effect on, at a share of their distance from rest.

    Values whose rest is infinite (a torque limit) stay.
    """
    result = {}
    for name, value in zip(self.term.names, self.start, strict=True):
      parameter = kind_of(self.kind).parameter(name)
      if not parameter.shape:
        rest = parameter.nominal
        result[name] = rest + share * (value - rest) if np.isfinite(rest) else value
    return result

  @property
  def distance(self) -> float:
    """How far the values are from those that do nothing, in typical sizes; of thresholds 0."""
    if not self.scales:
      return 0.0
    scale, rests = dict(zip(self.term.names, self.term.scale, strict=True)), self.sizes(0.0)
    return max(abs(value - rests[name]) / scale[name] for name, value in self.sizes().items())

  @property
  def scales(self) -> bool:
    """Whether the effect has sizes, all of which have a finite value at rest."""
    sized = [kind_of(self.kind).parameter(n) for n in self.term.names]
    rests = [p.nominal for p in sized if not p.shape]
    return bool(rests) and bool(np.all(np.isfinite(rests)))


def places(library: Sequence[Term]) -> list[Place]:
  """Returns every effect of a library at every place where its search starts."""
  return [Place(term, start) for term in library for start in term.starts]


def information(
  readings: Readings, own: Term, chosen: Sequence[Place], *, noise: Array, count: float
) -> Array:
  """Returns the information matrix [K, K] of effects along some motions.

  Args:
    readings: of terms with values, [C, N].
    own: the constants, whose prior is their tolerances.
    chosen: the effects.
    noise: of every channel [C].
    count: samples that count.
  """
  unit = (np.asarray(noise) * np.sqrt(count))[:, None]
  rest = np.array(own.starts[0])
  bare = readings((own,), rest)
  columns = []
  for at, sigma in enumerate(own.prior):
    moved = rest.copy()
    moved[at] += sigma
    columns.append(((readings((own,), moved) - bare) / unit).ravel())
  nothing: dict[Term, Array] = {}
  secants = []
  for place in chosen:
    idle = place.term.at_rest(dict(zip(place.term.names, place.start, strict=True)))
    if idle not in nothing:
      nothing[idle] = readings((own, idle), rest)
    on = readings((own, place.term), np.concatenate([rest, place.start]))
    secants.append(((on - nothing[idle]) / unit).ravel())
  tolerated, u = np.array(columns).T, np.array(secants).reshape(len(chosen), -1).T
  inner = np.linalg.solve(np.eye(len(columns)) + tolerated.T @ tolerated, tolerated.T @ u)
  return u.T @ u - (tolerated.T @ u).T @ inner


def of_logs(joint: JointLikelihood, own: Term, chosen: Sequence[Place]) -> Array:
  """Returns the information matrix [K, K] of effects along a joint's logs; see `information`."""
  readings = lambda terms, x: joint.residuals(terms, x[None])[0]  # noqa: E731
  return information(readings, own, chosen, noise=joint.floor, count=float(joint.mask.sum()))


def beside(matrix: Array, place: int, rivals: Sequence[int]) -> float:
  """Returns F_a|J, what rivals of any size leave of an effect's information.

  Args:
    matrix: information [K, K].
    place: a.
    rivals: J.
  """
  own = matrix[np.ix_(rivals, rivals)]
  scale = 1.0 / np.sqrt(np.maximum(np.diag(own), 1e-300))
  values, vectors = np.linalg.eigh(own * scale * scale[:, None])
  kept = values > _FLAT * values[-1]
  along = vectors[:, kept].T @ (scale * matrix[rivals, place])
  return max(float(matrix[place, place] - np.sum(along**2 / values[kept])), 0.0)
