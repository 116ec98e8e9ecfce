"""How clear a difference of two hypotheses is: tests of the same blocks, and all together."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from nerf2real.sysid.selection.search.evidence import (
  Scored,
  by_pattern,
  clearness,
  combined,
  more_likely,
  standardised,
)


def test_values_are_strained_where_they_are_further_off_than_by_chance():
  def scored(sigmas):
    layout = SimpleNamespace(sigma=np.ones(7), centre=np.zeros(7), count=7)
    fit = SimpleNamespace(x=np.full(7, sigmas / np.sqrt(7)), layout=layout)
    return Scored(None, (), fit, np.zeros(3))

  assert not scored(3.7).is_strained(0.05)
  assert scored(3.8).is_strained(0.05)  # 5 % of chi square with 7 degrees: 3.75 squared


def test_few_blocks_tell_what_a_log_holds_and_one_does_not():
  gains = np.zeros(40)
  gains[[3, 4, 30]] = 8.0
  assert standardised(gains) < 2.0
  assert more_likely(gains, 0.0, 0.05)
  assert not more_likely(gains, 14.0, 0.05)
  gains[[4, 30]] = 0.0
  assert not more_likely(gains, 0.0, 0.05)


def test_one_block_is_no_evidence():
  differences = np.zeros(30)
  differences[4] = 50.0
  assert standardised(differences) < 1.5
  assert standardised(np.full(30, 1.0) + np.linspace(-0.1, 0.1, 30)) > 20


def test_few_blocks_that_hold_most_of_a_sum_do_not_hide_that_all_agree():
  gains = np.full(36, 3.0)
  gains[12:16] = 100.0  # a motion that shows the effect most
  assert standardised(gains) < 2.6
  even = [np.ones(36)]
  pattern, ranks = by_pattern([gains], 0.0, even), 171.0 / np.sqrt(1768.5)  # 18 pairs, 16 alike
  assert pattern < 2.6 and ranks > 3.5
  together = combined([standardised(gains), pattern, ranks])
  assert clearness([gains], 0.0, even) == pytest.approx(together, abs=0.01) and together > 3.5
  gains[2::4] = -9.0  # as many pairs lose
  assert clearness([gains], 0.0, even) < standardised(gains)


def test_gains_that_lie_where_they_are_expected_are_clear_however_uneven():
  """Five blocks of which each gains what it should, and the same gains where none is expected."""
  random = np.random.default_rng(0)
  expected, gains = np.full(36, 0.1), random.normal(0.0, 0.3, 36)
  expected[[3, 9, 15, 22, 30]] = 40.0, 90.0, 60.0, 120.0, 50.0
  gains += expected * random.normal(1.0, 0.1, 36)
  assert standardised(gains) < 2.6
  assert by_pattern([gains], 0.0, [expected]) > 3.5
  assert by_pattern([gains], 0.0, [np.roll(expected, 1)]) < 2.0
  assert by_pattern([-gains], 0.0, [expected]) < -3.5
  one = np.where(np.arange(36) == 3, 90.0, 0.01)
  assert by_pattern([one], 0.0, [one]) < 1.0  # a single block draws its own line


def test_tests_that_agree_lose_nothing_by_their_number():
  assert combined([3.0, 3.0, 3.0]) == pytest.approx(3.0, abs=0.01)
  alone = combined([4.0, 0.0, 0.0])  # as by one of three tests (Bonferroni)
  assert norm.sf(alone) == pytest.approx(3.0 * norm.sf(4.0), rel=0.01)
  assert combined([-3.0, -2.0, -3.0]) == -combined([3.0, 2.0, 3.0]) < -2.0
  assert -40.0 < combined([-50.0, -40.0, -30.0]) < -30.0  # finite: reports are JSON
  assert combined([12.0, 0.0, 0.0]) > 11.0  # beyond what tan resolves


def test_differences_of_less_than_a_nat_agree_with_nothing():
  small = np.full(36, 0.4)
  assert clearness([small], 14.0, [small]) < 1.0  # pairs of 0.8 nats each, less the prior
  assert clearness([5.0 * small], 0.0, [small]) > 3.5


def test_hypotheses_without_a_difference_are_not_clear():
  assert clearness([np.zeros(36)], 0.0, [np.zeros(36)]) == 0.0
