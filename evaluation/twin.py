"""The simulation as a judge of policies: its success rates against those on virtual robots.

Shape letters: P policies, R resamples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.evaluation.episodes import Episode, select

_TAILS = (2.5, 97.5)  # percentiles of a 95 % interval
_MIN_POLICIES = 3


class Pair(NamedTuple):
  """A policy's successes in simulation and on virtual robots."""

  policy: str
  simulated: tuple[int, int]  # successes, episodes
  virtual: tuple[int, int]


class Interval(NamedTuple):
  """A figure with its 95 % bootstrap interval."""

  value: float
  low: float
  high: float


class Agreement(NamedTuple):
  """How well simulated success predicts success on virtual robots."""

  correlation: Interval  # Pearson's, of the success rates over policies
  difference: Interval  # mean of simulated minus virtual success rate


class _Kind(NamedTuple):
  """What the episodes of both plants must have in common to be compared."""

  protocol: str
  conditions: str

  def __str__(self) -> str:
    return f"{self.protocol}, {self.conditions or 'as in the paper'}"


def _kinds(plain: Sequence[Episode], plant: str) -> list[_Kind]:
  settings = [episode.setting for episode in select(plain, plant=plant)]
  return list(dict.fromkeys(_Kind(setting.protocol, setting.conditions) for setting in settings))


def pairs_of(found: Sequence[Episode]) -> list[Pair]:
  """Counts the undisturbed episodes of every policy that has some on both plants.

  One policy under several names is one.
  Protocol and conditions (scene, effects, ...) are the same for all: those that both plants have.

  Raises:
    ValueError: The plants have no conditions in common, or several.
  """
  plain = select(found, perturbation="none", control="none")
  simulated, virtual = (_kinds(plain, plant) for plant in ("sim", "virtual"))
  shared = [kind for kind in simulated if kind in virtual]
  if not simulated or not virtual:
    return []
  if len(shared) != 1:
    raise ValueError(
      f"Found simulations of ({'; '.join(map(str, simulated))}) and virtual robots of "
      f"({'; '.join(map(str, virtual))}), expected one protocol and conditions that both have: "
      "evaluate each into a folder of its own."
    )
  plain = select(plain, **shared[0]._asdict())
  pairs = []
  names: dict[str, str] = {}
  for episode in plain:
    names.setdefault(episode.setting.policy_id, episode.setting.policy)
  for digest, name in names.items():
    counts = []
    for plant in ("sim", "virtual"):
      own = select(plain, policy_id=digest, plant=plant)
      counts.append((sum(episode.success for episode in own), len(own)))
    if all(count for _, count in counts):
      pairs.append(Pair(f"{name} ({digest})", counts[0], counts[1]))
  return pairs


def agreement(pairs: Sequence[Pair], *, resamples: int = 10_000, seed: int = 0) -> Agreement:
  """Returns correlation and mean difference of the success rates, with intervals.

  The bootstrap draws policies with replacement and, for each, its episodes; resamples in which all
  rates of a plant are equal have no correlation and are left out of its interval.

  Args:
    pairs: Of the policies, P.
    resamples: R.
    seed: Of the bootstrap.

  Raises:
    ValueError: Fewer than three policies, or all of one rate.
  """
  if len(pairs) < _MIN_POLICIES:
    raise ValueError(
      f"Found {len(pairs)} policies with episodes on both plants, expected {_MIN_POLICIES} or more."
    )
  counts = np.array([[pair.simulated, pair.virtual] for pair in pairs])  # [P, 2, 2]
  rates = counts[..., 0] / counts[..., 1]  # [P, 2]
  if (np.ptp(rates, axis=0) == 0).any():
    raise ValueError("All policies have one success rate on a plant: take policies that differ.")
  rng = np.random.default_rng(seed)
  chosen = rng.integers(len(pairs), size=(resamples, len(pairs)))  # [R, P]
  totals = counts[chosen, :, 1]
  drawn = rng.binomial(totals, rates[chosen]) / totals  # [R, P, 2]
  correlations = _correlation(drawn[..., 0], drawn[..., 1])
  differences = (drawn[..., 0] - drawn[..., 1]).mean(axis=1)
  return Agreement(
    interval(float(_correlation(*rates.T[:, None])[0]), correlations),
    interval(float((rates[:, 0] - rates[:, 1]).mean()), differences),
  )


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Pearson's correlation [R] of rows [R, P]; NaN where a row is constant."""
  # Of the rates themselves: less their mean, equal ones are off zero by rounding.
  varied = (np.ptp(a, axis=1) > 0) & (np.ptp(b, axis=1) > 0)
  a, b = (x - x.mean(axis=1, keepdims=True) for x in (a, b))
  spread = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
  return np.where(varied, (a * b).sum(axis=1), np.nan) / np.where(varied, spread, 1.0)


def interval(value: float, drawn: np.ndarray) -> Interval:
  """Returns a figure with the interval of its resamples [R]; those that are NaN are left out."""
  low, high = np.nanpercentile(drawn, _TAILS)
  return Interval(value, float(low), float(high))
