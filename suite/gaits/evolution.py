"""CMA-ES: evolution strategy with covariance matrix adaptation, without a gradient.

Shapes: P parameters.
"""

import numpy as np


class Evolution:
  """CMA-ES: recombination, step size by its path, rank-mu and rank-one update, which never stalls.

  Source: Hansen, The CMA evolution strategy: a tutorial (arXiv 1604.00772), defaults of table 1.
  """

  def __init__(self, mean: np.ndarray, sigma: float, population: int, seed: int):
    self._rng = np.random.default_rng(seed)
    self.mean, self._sigma, size = mean.copy(), sigma, len(mean)
    parents = population // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    self._weights = weights / weights.sum()
    effective = 1 / (self._weights**2).sum()
    self._population = population
    self._c_sigma = (effective + 2) / (size + effective + 5)
    self._damping = 1 + self._c_sigma + 2 * max(0, np.sqrt((effective - 1) / (size + 1)) - 1)
    self._c_path = (4 + effective / size) / (size + 4 + 2 * effective / size)
    self._c_one = 2 / ((size + 1.3) ** 2 + effective)
    rank_mu = 2 * (effective - 2 + 1 / effective) / ((size + 2) ** 2 + effective)
    self._c_mu = min(1 - self._c_one, rank_mu)
    self._effective, self._expected = effective, np.sqrt(size) * (1 - 1 / (4 * size))
    self._covariance = np.eye(size)
    self._path_sigma, self._path = np.zeros(size), np.zeros(size)

  def ask(self) -> np.ndarray:
    """Returns candidates [population, P]."""
    values, vectors = np.linalg.eigh(self._covariance)
    self._root = vectors * np.sqrt(np.maximum(values, 1e-12))
    self._inverse = vectors / np.sqrt(np.maximum(values, 1e-12)) @ vectors.T
    noise = self._rng.standard_normal((self._population, len(self.mean)))
    return self.mean + self._sigma * noise @ self._root.T

  def tell(self, candidates: np.ndarray, scores: np.ndarray) -> None:
    """Moves towards the candidates with the highest scores [population]."""
    best = candidates[np.argsort(-scores)[: len(self._weights)]]
    steps = (best - self.mean) / self._sigma
    step = self._weights @ steps
    self.mean = self.mean + self._sigma * step
    c, mu = self._c_sigma, self._effective
    self._path_sigma = (1 - c) * self._path_sigma + np.sqrt(c * (2 - c) * mu) * self._inverse @ step
    c = self._c_path
    self._path = (1 - c) * self._path + np.sqrt(c * (2 - c) * mu) * step
    self._covariance = (
      (1 - self._c_one - self._c_mu) * self._covariance
      + self._c_one * np.outer(self._path, self._path)
      + self._c_mu * (steps.T * self._weights) @ steps
    )
    length = np.linalg.norm(self._path_sigma) / self._expected
    self._sigma *= float(np.exp(self._c_sigma / self._damping * (length - 1)))
