"""Paired differences: who is paired with whom, and intervals that hold what they should."""

import numpy as np
import pytest

from nerf2real.evaluation import paired
from tests.evaluation.fakes import episode


def test_without_a_discordant_trial_the_interval_has_its_closed_form():
  """T(d)^2 = N d / (1 - d) if nothing was won or lost."""
  z = 1.959964
  found = paired.success_difference(0, 0, 15)
  assert found.value == 0
  assert found.high == pytest.approx(z**2 / (15 + z**2), rel=1e-5)
  assert found.low == pytest.approx(-found.high)


def test_the_interval_turns_with_its_sides_and_narrows_with_trials():
  found, turned = paired.success_difference(6, 1, 20), paired.success_difference(1, 6, 20)
  assert found.value == pytest.approx(0.25)
  assert (found.low, found.high) == pytest.approx((-turned.high, -turned.low))
  assert found.low < 0.25 < found.high
  more = paired.success_difference(60, 10, 200)
  assert found.low < more.low and more.high < found.high
  all_won = paired.success_difference(9, 0, 9)
  assert all_won.value == all_won.high == 1 and all_won.low < 0.8


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
  rng, inside = np.random.default_rng(0), 0
  for won, lost, _ in rng.multinomial(20, (0.25, 0.1, 0.65), 400):
    found = paired.success_difference(int(won), int(lost), 20)
    inside += found.low <= 0.15 <= found.high
  assert 0.92 <= inside / 400 <= 0.98


def test_trials_are_paired_by_index_and_robot():
  def on(robot, outcome, index, **changes):
    return episode(outcome, plant="virtual", plant_id=robot, index=index, **changes)

  reference = [
    on("robot 1", "success", 0, time=10.0, localisation_error=0.1),
    on("robot 1", "collision", 1),
    on("robot 2", "success", 0, time=20.0, localisation_error=0.3),
    on("robot 2", "success", 5),
  ]
  found = [
    on("robot 1, the simulation's picture", "success", 0, time=12.0, localisation_error=0.05),
    on("robot 1, the simulation's picture", "success", 1),
    on("robot 2, the simulation's picture", "fall", 0),
    on("robot 2, the simulation's picture", "success", 9),
  ]
  result = paired.difference(found, reference)
  assert (result.trials, result.won, result.lost) == (3, 1, 1)
  assert result.success.value == 0
  assert result.time == (2.0, 2.0, 2.0)
  assert result.error is not None and result.error.value == pytest.approx(-0.05)
  simulated = [episode(index=1, plant_id="seed 0"), episode("fall", index=0, plant_id="seed 0")]
  nominal = [episode(index=0, plant_id="seed 0, the robot's delay")]
  assert paired.difference(nominal, simulated).won == 1
  both = paired.difference(reference, simulated)
  assert (both.trials, both.won, both.lost) == (3, 2, 1)
  with pytest.raises(ValueError, match="no trial in common"):
    paired.difference(simulated, reference)


def test_trials_of_several_conditions_are_not_paired():
  simulated = [episode(index=0)]
  twice = [episode(index=0, policy_id="d1"), episode("fall", index=0, policy_id="d2")]
  for found, reference in ((twice, simulated), (simulated, twice)):
    with pytest.raises(ValueError, match="trial 0 twice, expected episodes of one policy"):
      paired.difference(found, reference)
  with pytest.raises(ValueError, match="no trial in common"):
    paired.difference([episode(index=0, protocol="gain")], simulated)
