"""The exact confidence interval of a probability, from counts."""

from typing import NamedTuple

from scipy import stats


class Interval(NamedTuple):
  """An interval of a probability."""

  low: float
  high: float


def clopper_pearson(successes: int, trials: int) -> Interval:
  """Returns the exact 95 % interval of a success rate (Clopper and Pearson 1934).

  Raises:
    ValueError: There are no trials, or more successes than trials.
  """
  found = stats.binomtest(successes, trials).proportion_ci(0.95, method="exact")
  return Interval(float(found.low), float(found.high))
