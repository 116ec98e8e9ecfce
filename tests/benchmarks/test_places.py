"""Tests of how localised places are compared with the true ones."""

import numpy as np

from benchmarks.drawn_rooms import places
from nerf2real.core.geometry.similarity import Similarity


def test_a_wrong_place_does_not_move_the_others():
  random = np.random.default_rng(0)
  true = random.uniform(-2, 2, (20, 3))
  found = Similarity(0.3, np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0])).apply(true)
  found[[4, 11]] += [[0.6, 0, 0], [0, 0.15, 0]]  # 2 m and half a metre
  expected = np.zeros(20)
  expected[[4, 11]] = 2.0, 0.5
  np.testing.assert_allclose(places.position_errors(found, true), expected, atol=1e-9)
