"""Simulation as a judge: correlation and difference of success rates, with their intervals."""

import numpy as np
import pytest

from nerf2real.evaluation import twin
from nerf2real.evaluation.twin import Pair
from tests.evaluation.fakes import episode


def _pairs(simulated, virtual, count):
  return [
    Pair(str(i), (round(a * count), count), (round(b * count), count))
    for i, (a, b) in enumerate(zip(simulated, virtual, strict=True))
  ]


def test_the_correlation_is_numpys_and_many_episodes_narrow_it():
  simulated, virtual = [0.1, 0.3, 0.5, 0.6, 0.8, 0.9], [0.1, 0.2, 0.5, 0.5, 0.7, 0.9]
  found = twin.agreement(_pairs(simulated, virtual, 1000))
  assert found.correlation.value == pytest.approx(np.corrcoef(simulated, virtual)[0, 1])
  assert found.difference.value == pytest.approx(0.05)
  assert 0.9 < found.correlation.low < found.correlation.value < found.correlation.high <= 1
  few = twin.agreement(_pairs(simulated, virtual, 10))
  assert few.correlation.low < found.correlation.low
  assert few.difference.low < 0 < few.difference.high


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
  """Rates with a difference of 0.1 on 40 episodes each: the mean difference's coverage."""
  rng, inside = np.random.default_rng(0), 0
  for _ in range(200):
    rates = rng.uniform(0.2, 0.8, 8)
    counts = rng.binomial(40, np.stack([rates + 0.05, rates - 0.05], axis=1))
    pairs = [Pair(str(i), (a, 40), (b, 40)) for i, (a, b) in enumerate(counts)]
    found = twin.agreement(pairs, resamples=400).difference
    inside += found.low <= 0.1 <= found.high
  assert 0.9 <= inside / 200 <= 1.0


def test_unrelated_rates_have_an_interval_about_zero():
  found = twin.agreement(_pairs([0.2, 0.4, 0.6, 0.8], [0.5, 0.3, 0.7, 0.5], 20)).correlation
  assert found.low < 0 < found.high


def test_resamples_of_one_rate_are_left_out():
  # 0.7 less the mean of seven times 0.7 is no zero in floating point.
  pairs = [Pair(str(i), (7, 10), (7, 10)) for i in range(6)] + [Pair("6", (10, 10), (10, 10))]
  constant = np.full((1, 7), 0.7)
  assert np.isnan(twin._correlation(constant, np.array([[p.virtual[0] / 10 for p in pairs]])))
  assert np.isnan(twin._correlation(constant, constant))


def test_too_few_or_equal_policies_are_refused():
  with pytest.raises(ValueError, match="Found 2 policies"):
    twin.agreement(_pairs([0.2, 0.4], [0.2, 0.4], 10))
  with pytest.raises(ValueError, match="one success rate on a plant"):
    twin.agreement(_pairs([0.2, 0.4, 0.6], [0.5, 0.5, 0.5], 10))


def test_episodes_are_counted_by_policy_and_plant():
  found = [
    episode(index=0),
    episode("lost", index=1),
    episode("lost", index=0, control="black"),
    episode(index=0, plant="virtual", plant_id="robot 1"),
    episode("fall", index=0, plant="virtual", plant_id="robot 2"),
    episode("fall", index=0, plant="virtual", plant_id="robot 3", perturbation="person"),
    episode(index=0, policy_id="d2"),
  ]
  assert twin.pairs_of(found) == [Pair("p (d1)", (1, 2), (1, 2))]
  renamed = [episode(policy="q", index=2, plant=plant) for plant in ("sim", "virtual")]
  assert twin.pairs_of(found + renamed) == [Pair("p (d1)", (2, 3), (2, 3))]  # one policy
  # Of other conditions that one plant alone has, nothing is counted.
  others = [episode("fall", conditions="effects 0a"), episode("fall", protocol="ball")]
  assert twin.pairs_of(found + others) == twin.pairs_of(found)
  assert twin.pairs_of(others) == twin.pairs_of([]) == []


def test_conditions_are_not_pooled():
  there = [episode(plant=plant) for plant in ("sim", "virtual")]
  other = [episode("lost", plant=plant, conditions="scene x (0a)") for plant in ("sim", "virtual")]
  assert twin.pairs_of(other) == [Pair("p (d1)", (0, 1), (0, 1))]
  for found in (there + other, [there[0], other[1]]):
    with pytest.raises(
      ValueError, match=r"navigation, scene x \(0a\).*folder of its own"
    ) as caught:
      twin.pairs_of(found)
    assert "navigation, as in the paper" in str(caught.value) and "\n" not in str(caught.value)
