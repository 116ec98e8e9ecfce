"""Exact intervals of a probability, against their definition."""

import numpy as np
import pytest
from scipy import stats

from nerf2real.core.intervals import clopper_pearson


@pytest.mark.parametrize(
  ("successes", "count", "expected"),
  [(0, 18, (0.0, 0.1853)), (18, 18, (0.8147, 1.0)), (15, 27, (0.3533, 0.7452))],
)
def test_clopper_pearson(successes, count, expected):
  np.testing.assert_allclose(clopper_pearson(successes, count), expected, atol=1e-4)


def test_clopper_pearson_s_definition():
  """At the lower end, as many successes or more have a chance of 2.5 %; at the upper end, fewer."""
  low, high = clopper_pearson(4, 9)
  assert stats.binom.sf(3, 9, low) == pytest.approx(0.025)
  assert stats.binom.cdf(4, 9, high) == pytest.approx(0.025)
  with pytest.raises(ValueError, match="greater than"):
    clopper_pearson(10, 9)
