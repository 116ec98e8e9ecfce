"""Normal equations of poses and points, of which the points are eliminated (Schur's complement).

Shapes: U unknowns that stay, P points, O observations.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse


class Reduced(NamedTuple):
  """Normal equations of the unknowns that stay."""

  curvature: np.ndarray  # [U, U]
  gradient: np.ndarray  # [U]
  inverse: sparse.bsr_matrix  # of the points' own curvature [3 P, 3 P]
  mixed: sparse.csr_matrix  # [U, 3 P]
  of_points: np.ndarray  # the points' gradient [3 P]

  def points(self, step: np.ndarray) -> np.ndarray:
    """Steps of the points [P, 3] that go with a step of the others [U]."""
    found: np.ndarray = -(self.inverse @ (self.of_points + self.mixed.T @ step)).reshape(-1, 3)
    return found


def eliminate(
  by_others: sparse.csr_matrix,
  by_points: np.ndarray,
  point: np.ndarray,
  errors: np.ndarray,
  *,
  damping: float,
) -> Reduced:
  """Returns the normal equations of a least-squares step without its points.

  Args:
    by_others: Derivatives of the errors by the unknowns that stay [2 O, U].
    by_points: Those by the point that is observed [O, 2, 3].
    point: Of which point each observation is [O]; every point from 0 to P - 1 has one.
    errors: The residuals [2 O].
    damping: Added to the curvature of all, as a share of it.
  """
  count = 1 + int(point.max())
  rows = np.arange(len(point) + 1)
  inner = sparse.bsr_matrix((by_points, point, rows), shape=(len(errors), 3 * count)).tocsr()
  blocks = np.zeros((count, 3, 3))
  np.add.at(blocks, point, np.swapaxes(by_points, 1, 2) @ by_points)
  sizes = np.maximum(np.trace(blocks, axis1=1, axis2=2), 1.0)  # of one that nothing holds, too
  blocks += damping * sizes[:, None, None] * np.eye(3)
  inverse = sparse.bsr_matrix(
    (np.linalg.inv(blocks), np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
  )
  mixed = by_others.T @ inner
  eliminated = mixed @ inverse
  own = (by_others.T @ by_others).toarray()
  of_points = inner.T @ errors
  return Reduced(
    curvature=own - (eliminated @ mixed.T).toarray() + damping * np.diag(own.diagonal()),
    gradient=by_others.T @ errors - eliminated @ of_points,
    inverse=inverse,
    mixed=mixed,
    of_points=of_points,
  )
