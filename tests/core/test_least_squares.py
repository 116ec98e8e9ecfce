"""Covariances against their definition: the scatter of fits over repeated draws of the noise."""

import numpy as np
import pytest
from scipy import optimize

from nerf2real.core import least_squares

X = np.linspace(-1, 2, 60)
DESIGN = np.stack([np.ones_like(X), X])  # [n, N]
BLOCKS = np.repeat(np.arange(12), 5)


def scatter(noise):
  """Returns the covariance of a straight line's parameters over draws of the noise [M, N]."""
  return np.cov(np.stack([np.linalg.lstsq(DESIGN.T, e, rcond=None)[0] for e in noise]).T)


def test_independent_noise():
  noise = 0.3 * np.random.default_rng(0).standard_normal((4000, len(X)))
  found = least_squares.covariance(DESIGN, variance=0.3**2)
  np.testing.assert_allclose(found, scatter(noise), rtol=0.1, atol=1e-4)


def test_noise_that_is_alike_within_blocks():
  rng = np.random.default_rng(1)
  noise = np.repeat(rng.standard_normal((4000, 12)), 5, axis=1)
  found = np.mean(
    [least_squares.block_covariance(DESIGN, row, BLOCKS) for row in noise[:1000]], axis=0
  )
  np.testing.assert_allclose(found, scatter(noise), rtol=0.12, atol=2e-3)
  assert found[0, 0] > 3 * least_squares.covariance(DESIGN)[0, 0]


def test_a_prior_alone_gives_its_own_covariance():
  prior = np.diag([4.0, 9.0])
  nothing = np.zeros((2, 6, 3))
  for found in (
    least_squares.covariance(nothing, prior=prior),
    least_squares.block_covariance(nothing, np.zeros((6, 3)), np.arange(6), prior=prior),
  ):
    np.testing.assert_allclose(least_squares.standard_deviations(found), [1 / 2, 1 / 3])


def test_what_is_not_determined_is_not_moved():
  jacobian = np.stack([X, np.zeros_like(X)])
  step = least_squares.gauss_newton_step(jacobian, 2 * X, rcond=1e-9)
  np.testing.assert_allclose(step, [2, 0], atol=1e-12)
  assert least_squares.covariance(jacobian)[1, 1] == 0


def test_the_prior_pulls_to_its_mean():
  step = least_squares.gauss_newton_step(
    np.array([[1.0]]),
    np.array([0.0]),
    prior_precision=np.array([3.0]),
    prior_offset=np.array([4.0]),
  )
  assert step == pytest.approx([3.0])  # of the way of 4 back, 3 shares of 4


def test_reweighting_minimises_the_cauchy_loss():
  rng = np.random.default_rng(2)
  seen = 1 + 2 * X + 0.05 * rng.standard_normal(len(X))
  seen[::7] += 5  # outliers
  x = np.zeros(2)
  for _ in range(200):
    residual = x @ DESIGN - seen
    weight = least_squares.cauchy_weights(residual, 0.1)
    x = x - least_squares.gauss_newton_step(DESIGN * weight, residual * weight)
  expected = optimize.least_squares(
    lambda y: y @ DESIGN - seen, [1, 2], loss="cauchy", f_scale=0.1, xtol=1e-12, ftol=1e-12
  )
  np.testing.assert_allclose(x, expected.x, atol=1e-5)
  np.testing.assert_allclose(x, [1, 2], atol=0.05)
