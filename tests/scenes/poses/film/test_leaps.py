"""Tests of where a hand would have had to leap."""

import numpy as np

from nerf2real.scenes.poses.film.leaps import leaps


def walk(count: int) -> tuple[np.ndarray, np.ndarray]:
  """A hand that turns and changes its speed, and when: [N, 3], [N]."""
  times = np.cumsum(np.random.default_rng(0).uniform(0.2, 0.6, count))
  return np.stack([np.sin(0.5 * times), np.cos(0.3 * times), 0.1 * np.sin(times)], 1), times


def test_a_hand_does_not_leap_however_fast_it_is():
  centers, times = walk(60)
  assert not leaps(centers, times).any()
  assert not leaps(10 * centers, times).any()
  waits = np.maximum(np.arange(60.0) - 45, 0.0)  # three quarters of it stand still
  assert not np.diagonal(leaps(np.stack([waits, 0 * waits, 0 * waits], 1), times), 1).any()


def test_pictures_that_stand_elsewhere_are_leapt_to_and_from():
  centers, times = walk(60)
  centers[20:27, 2] += 1.0
  found = leaps(centers, times)
  assert np.flatnonzero(np.diagonal(found, 1)).tolist() == [19, 26]
  assert not np.tril(found).any()


def test_a_knock_is_no_leap():
  """The hand's velocity changes, but it comes out close to where it would have been."""
  centers, times = walk(60)
  times[20] = times[19] + 0.03
  centers[20] = centers[19] + [0.0, 0.0, 0.1]
  assert not np.diagonal(leaps(centers, times), 1).any()


def test_without_times_nothing_is_said():
  centers, times = walk(60)
  centers[20, 2] += 5.0
  assert not leaps(centers, times[::-1]).any()
  assert not leaps(centers[:2], times[:2]).any()
  assert leaps(centers[:0], times[:0]).shape == (0, 0)
