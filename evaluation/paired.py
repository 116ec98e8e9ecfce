"""Differences between two conditions on the same trials: success, time to the goal, localisation.

Shape letters: N trials, R resamples.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from nerf2real.evaluation.episodes import Episode
from nerf2real.evaluation.twin import Interval, interval

_QUANTILE = float(stats.norm.ppf(0.975))


class Difference(NamedTuple):
  """A condition less its reference, trial by trial; None where no trial has the quantity."""

  trials: int
  won: int  # reached the goal where the reference did not
  lost: int  # the other way around
  success: Interval
  time: Interval | None  # s, over the trials in which both reach the goal
  error: Interval | None  # m, localisation error, over the same


def difference(found: Sequence[Episode], reference: Sequence[Episode]) -> Difference:
  """Returns the differences over the trials of one robot and index that both have.

  A trial of a virtual robot is paired with the same robot's, or with the simulation's.

  Raises:
    ValueError: They have no trial in common, or one has a trial twice.
  """
  for episodes in (found, reference):
    twice = [trial for trial, count in Counter(map(_trial, episodes)).items() if count > 1]
    if twice:
      robot, _, index = twice[0]
      raise ValueError(
        f"Found trial {index} twice{f' of {robot}' if robot else ''}, expected episodes of one "
        "policy, protocol and seed: select them, or evaluate each into a folder of its own."
      )
  others = {_trial(episode): episode for episode in reference}
  partners = [(a, others.get(_trial(a)) or others.get(("", *_trial(a)[1:]))) for a in found]
  pairs = [(a, b) for a, b in partners if b is not None]
  if not pairs:
    raise ValueError("The two conditions have no trial in common: evaluate both on the same.")
  won = sum(a.success and not b.success for a, b in pairs)
  lost = sum(b.success and not a.success for a, b in pairs)
  both = [(a, b) for a, b in pairs if a.success and b.success]
  times = [a.time - b.time for a, b in both if a.time is not None and b.time is not None]
  errors = [
    a.localisation_error - b.localisation_error
    for a, b in both
    if a.localisation_error is not None and b.localisation_error is not None
  ]
  success = success_difference(won, lost, len(pairs))
  return Difference(len(pairs), won, lost, success, mean(times), mean(errors))


def _trial(episode: Episode) -> tuple[str, str, int]:
  """Returns what pairs an episode: the virtual robot's seed, the protocol and the trial in it."""
  robot = episode.setting.plant_id.partition(",")[0] if episode.setting.plant == "virtual" else ""
  return robot, episode.setting.protocol, episode.index


def mean(values: Sequence[float], *, resamples: int = 10_000, seed: int = 0) -> Interval | None:
  """Returns the mean of values [N] with its 95 % bootstrap interval; None without values."""
  if not len(values):
    return None
  drawn = np.random.default_rng(seed).choice(values, (resamples, len(values))).mean(axis=1)
  return interval(float(np.mean(values)), drawn)


def success_difference(won: int, lost: int, trials: int) -> Interval:
  """Returns the difference of two paired success rates with its 95 % score interval.

  The interval holds every difference d with |T(d)| <= z, T(d) = (won - lost - N d) /
  sqrt(N (2 q + d (1 - d))), where q is the maximum-likelihood probability of losing a trial given d
  (Tango, Equivalence test and confidence interval for the difference in proportions for the
  paired-sample design, Statistics in Medicine 17, 1998, section 3).

  Args:
    won: Trials that the condition alone reached.
    lost: Trials that the reference alone reached.
    trials: All trials N.
  """

  def statistic(d: float) -> float:
    b = -won - lost + (2 * trials - won + lost) * d
    root = np.sqrt(max(0.0, b * b + 8 * trials * lost * d * (1 - d)))
    variance = trials * ((root - b) / (2 * trials) + d * (1 - d))
    return float((won - lost - trials * d) / np.sqrt(max(variance, 1e-12)))

  value, edge = (won - lost) / trials, 1 - 1e-9

  def bound(sign: float) -> float:
    if sign * value >= edge:
      return sign
    return float(optimize.brentq(lambda d: statistic(d) + sign * _QUANTILE, value, sign * edge))

  return Interval(value, bound(-1.0), bound(1.0))
