"""Pictures are divided where they have least to do with each other."""

import itertools

import numpy as np
import pytest

from nerf2real.scenes.poses.checks import division


def _weights(count, group, *, within, across, seed=0):
  """Weights [N, N] of pictures of which a group agrees within and is against the others."""
  random = np.random.default_rng(seed)
  inside = np.isin(np.arange(count), group)
  mean = np.where(inside[:, None] == inside, within, across)
  weights = np.triu(mean * random.uniform(0.2, 1.8, (count, count)), 1)
  return weights + weights.T


@pytest.mark.parametrize("group", [[3], [0, 1, 2], [4, 7, 8, 9, 11]])
def test_a_group_that_is_more_against_the_others_than_with_them_is_found(group):
  found = division.divide(_weights(12, group, within=10.0, across=-1.0))
  assert np.flatnonzero(found).tolist() == group


def test_no_division_of_few_pictures_has_a_lesser_sum_across():
  random = np.random.default_rng(1)
  for _ in range(20):
    weights = np.triu(random.normal(1.0, 3.0, (7, 7)), 1)
    weights += weights.T
    sides = np.array(list(itertools.product((False, True), repeat=7)))[1:-1]
    sums = [weights[side][:, ~side].sum() for side in sides]
    found = division.divide(weights)
    if found is None:
      assert min(sums) >= 0
    else:
      assert weights[found][:, ~found].sum() == pytest.approx(min(sums))
      assert found.sum() <= 3


def test_pictures_that_agree_or_have_nothing_in_common_are_not_divided():
  assert division.divide(_weights(9, [0, 1], within=3.0, across=0.5)) is None
  assert division.divide(np.zeros((4, 4))) is None
