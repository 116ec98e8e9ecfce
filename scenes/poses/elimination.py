"""Normal equations of poses and points, of which the points are eliminated (Schur's complement).

Shapes: N pictures, S unknowns that all pictures share, U = 6 N + S unknowns that stay, P points,
O observations.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse


class Sights(NamedTuple):
  """Derivatives of the residuals of all observations."""

  picture: np.ndarray  # in which each is seen, from 0 to N - 1, in order [O]
  point: np.ndarray  # which is seen; every one from 0 to P - 1 is [O]
  by_pose: np.ndarray  # by the picture's pose [O, 2, 6]
  by_point: np.ndarray  # by the point [O, 2, 3]
  shared: np.ndarray  # by the unknowns that all share [O, 2, S]
  errors: np.ndarray  # the residuals [O, 2]


class Reduced(NamedTuple):
  """Normal equations of the unknowns that stay: poses in the order of pictures, then the shared."""

  curvature: np.ndarray  # [U, U]
  gradient: np.ndarray  # [U]
  inverse: np.ndarray  # of the points' own curvature [P, 3, 3]
  mixed: sparse.bsr_matrix  # of poses and points [6 N, 3 P]
  mixed_shared: np.ndarray  # of what is shared and points [S, 3 P]
  of_points: np.ndarray  # the points' gradient [P, 3]

  def points(self, step: np.ndarray) -> np.ndarray:
    """Steps of the points [P, 3] that go with a step of the others [U]."""
    poses = self.mixed.shape[0]
    by_others = self.mixed.T @ step[:poses] + self.mixed_shared.T @ step[poses:]
    gradient = self.of_points + by_others.reshape(-1, 3)
    found: np.ndarray = -np.einsum("pij,pj->pi", self.inverse, gradient)
    return found


def eliminate(sights: Sights, pictures: int, *, damping: float) -> Reduced:
  """Returns the normal equations of a least-squares step without its points.

  Args:
    sights: Of all observations.
    pictures: N; a picture may have no observation.
    damping: Added to the curvature of all, as a share of it.
  """
  picture, point, by_pose, by_point, shared, errors = sights
  count, rows = 1 + int(point.max()), np.searchsorted(picture, np.arange(pictures + 1))
  of_point, of_pose = by_point.swapaxes(1, 2), by_pose.swapaxes(1, 2)
  own = _sums(of_point @ by_point, point, count)
  sizes = np.maximum(np.trace(own, axis1=1, axis2=2), 1.0)  # of one that nothing holds, too
  inverse = np.linalg.inv(own + damping * sizes[:, None, None] * np.eye(3))
  gradient = _sums(_times(of_point, errors), point, count)

  def by_pictures(blocks: np.ndarray) -> sparse.bsr_matrix:  # [6 N, 3 P] of its blocks [O, 6, 3]
    return sparse.bsr_matrix((blocks, point, rows), shape=(6 * pictures, 3 * count))

  # A block of a picture and a point [O, 6, 3], and of the shared unknowns and a point [S, P, 3].
  blocks = of_pose @ by_point
  blocks_shared = _sums(shared.swapaxes(1, 2) @ by_point, point, count).swapaxes(0, 1)
  mixed, eliminated = by_pictures(blocks), by_pictures(blocks @ inverse[point])
  flat = blocks_shared.reshape(-1, 3 * count)
  flat_eliminated = np.einsum("spi,pij->spj", blocks_shared, inverse).reshape(-1, 3 * count)

  poses = -(eliminated @ mixed.T).toarray()
  diagonal = poses.reshape(pictures, 6, pictures, 6)
  diagonal[np.arange(pictures), :, np.arange(pictures), :] += _sums(
    of_pose @ by_pose, picture, pictures
  )
  between = _sums(of_pose @ shared, picture, pictures).reshape(6 * pictures, -1)
  between -= eliminated @ flat.T
  together = np.einsum("oes,oet->st", shared, shared)
  size = np.concatenate(
    [_sums(np.square(by_pose).sum(1), picture, pictures).ravel(), np.diagonal(together)]
  )
  curvature = np.block([[poses, between], [between.T, together - flat_eliminated @ flat.T]])
  curvature[np.diag_indices_from(curvature)] += damping * size
  of_others = np.concatenate(
    [
      _sums(_times(of_pose, errors), picture, pictures).ravel() - eliminated @ gradient.ravel(),
      np.einsum("oes,oe->s", shared, errors) - flat_eliminated @ gradient.ravel(),
    ]
  )
  return Reduced(curvature, of_others, inverse, mixed, flat, gradient)


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
  """Products [O, K] of matrices [O, K, 2] and vectors [O, 2]."""
  found: np.ndarray = (matrices @ vectors[..., None])[..., 0]
  return found


def _sums(values: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
  """Sums of values [O, ...] that have the same index, from 0 to the count [count, ...]."""
  found = np.zeros((count, *values.shape[1:]))
  np.add.at(found, index, values)
  return found
