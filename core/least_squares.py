"""Covariances of least-squares fits: from the residual's variance, or from its scatter over blocks.

Fits themselves are scipy.optimize.least_squares, with a robust loss where outliers occur; where
measurements count in groups (the tracks of a picture), Gauss-Newton with `gauss_newton_step` and
`cauchy_weights`. Shapes: n parameters, N residuals, which may have further axes.
"""

import numpy as np


def cauchy_weights(size: np.ndarray, scale: float) -> np.ndarray:
  """Returns the factors on residual and Jacobian that make squares the Cauchy loss.

  1 / sqrt(1 + (size / scale)^2): iteratively reweighted, sum (w r)^2 has the minimum of
  sum log(1 + (r / scale)^2). Source: Holland and Welsch 1977, Robust regression using iteratively
  reweighted least-squares.

  Args:
    size: Magnitudes of the residuals.
    scale: Magnitude at which a residual starts to count less.
  """
  return 1.0 / np.sqrt(1.0 + np.square(size / scale))


def gauss_newton_step(
  jacobian: np.ndarray,
  residual: np.ndarray,
  *,
  prior_precision: np.ndarray | None = None,
  prior_offset: np.ndarray | None = None,
  rcond: float | None = None,
) -> np.ndarray:
  """Returns the step [n] to subtract from the parameters: (J J' + P) step = J r + P offset.

  Args:
    jacobian: Derivatives [n, N, ...] of the residuals, weighted.
    residual: [N, ...], weighted.
    prior_precision: Diagonal [n] of P, inverse variances of a Gaussian prior.
    prior_offset: Parameters minus the prior's mean [n].
    rcond: Relative size of singular values of the normal matrix that count as 0; what they span
      is not moved.
  """
  flat = jacobian.reshape(len(jacobian), -1)
  normal, gradient = flat @ flat.T, flat @ residual.ravel()
  if prior_precision is not None:
    normal = normal + np.diag(prior_precision)
  if prior_precision is not None and prior_offset is not None:
    gradient = gradient + prior_precision * prior_offset
  return np.linalg.lstsq(normal, gradient, rcond=rcond)[0]


def covariance(
  jacobian: np.ndarray, *, variance: float = 1.0, prior: np.ndarray | None = None, rcond=1e-12
) -> np.ndarray:
  """Returns the covariance [n, n] of a fit with independent residuals: variance (J J' + P)^+.

  Args:
    jacobian: Derivatives [n, N, ...] of the residuals, weighted as in the fit. That of
      scipy.optimize.least_squares is the transpose.
    variance: Of a residual; 1 where the weights are inverse standard deviations.
    prior: Precision matrix P [n, n] of a Gaussian prior.
    rcond: Relative size of singular values that count as 0: what is not determined gets variance 0.
  """
  flat = jacobian.reshape(len(jacobian), -1)
  normal = flat @ flat.T if prior is None else flat @ flat.T + prior
  return np.linalg.pinv(normal, rcond=rcond) * variance


def block_covariance(
  jacobian: np.ndarray,
  residual: np.ndarray,
  blocks: np.ndarray,
  *,
  prior: np.ndarray | None = None,
  rcond: float = 1e-12,
) -> np.ndarray:
  """Returns the covariance [n, n] of a fit whose residuals are alike within blocks (sandwich).

  H^-1 (sum over blocks of g g' + P) H^-1 with H = J J' + P and g = J_b r_b.
  Source: Liang and Zeger 1986, Longitudinal data analysis using generalized linear models, eq. 9.

  Args:
    jacobian: Derivatives [n, N, ...] of the residuals, weighted as in the fit.
    residual: [N, ...], weighted as in the fit.
    blocks: The block that each residual is in [N].
    prior: Precision matrix P [n, n] of a Gaussian prior.
    rcond: As in `covariance`.
  """
  inverse = covariance(jacobian, prior=prior, rcond=rcond)
  count = len(jacobian)
  meat = np.zeros((count, count)) if prior is None else prior.copy()
  for block in np.unique(blocks):
    inside = blocks == block
    gradient = jacobian[:, inside].reshape(count, -1) @ residual[inside].ravel()
    meat += np.outer(gradient, gradient)
  return inverse @ meat @ inverse


def standard_deviations(covariance: np.ndarray) -> np.ndarray:
  """Returns the roots of a covariance's diagonal [n]; rounding below 0 counts as 0."""
  return np.sqrt(np.maximum(np.diag(covariance), 0.0))
