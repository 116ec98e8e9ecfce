"""Tests of where keyframes lie in a film."""

import cv2
import numpy as np
import pytest

from nerf2real.scenes.capture.media.spacing import ImageMotion, spread


def _texture():
  noise = np.random.default_rng(0).integers(0, 255, (240, 640), dtype=np.uint8)
  return cv2.GaussianBlur(noise, (0, 0), 2)


def test_motion_is_that_of_the_picture_at_a_short_side_of_160():
  wide, motion = _texture(), ImageMotion()
  for column in (0, 3, 9, 9):
    travelled = motion.add(wide[:, column : column + 320])
  assert travelled == pytest.approx(9 * 160 / 240, rel=0.02)


def test_a_frame_without_anything_to_follow_moves_as_the_one_before():
  wide, motion = _texture(), ImageMotion()
  for column in (0, 3):
    motion.add(wide[:, column : column + 320])
  plain = np.full((240, 320), 128, np.uint8)
  travelled = [motion.add(plain) for _ in range(3)]
  first, second = np.diff(travelled)
  assert first == second > 0.0


def test_a_film_that_moves_evenly_is_cut_into_equal_parts():
  index = np.arange(30)
  sharp = np.tile([1.0, 3.0, 2.0], 10)
  np.testing.assert_array_equal(spread(index, 0.7 * index, sharp, 10), np.arange(1, 30, 3))


def test_no_gap_is_longer_than_twice_an_even_one_in_time_or_in_motion():
  generator = np.random.default_rng(1)
  step = np.where(np.arange(600) // 100 == 2, 6.0, 0.5) * generator.uniform(0.8, 1.2, 600)
  travelled = np.cumsum(step)
  rows = spread(np.arange(600), travelled, np.zeros(600), 100)  # the first of each part
  assert len(rows) == 100 and np.all(np.diff(rows) > 0)
  assert np.diff(rows).max() <= 2 * 600 / 100 + 1
  assert np.diff(travelled[rows]).max() <= 2 * travelled[-1] / 100 + step.max()
  fast = (rows >= 200) & (rows < 300)
  assert fast.sum() > 35  # of 17 where time alone counts


def test_a_film_without_motion_is_cut_into_equal_parts():
  sharp = np.tile([1.0, 3.0, 2.0], 10)
  np.testing.assert_array_equal(spread(np.arange(30), np.zeros(30), sharp, 10), np.arange(1, 30, 3))


def test_frames_of_a_variable_rate_count_by_their_times():
  time = np.concatenate([np.arange(100) / 100, 1 + np.arange(100) / 10])  # 1 s, then 10 s
  rows = spread(time, time, np.zeros(200), 11)
  assert (rows < 100).sum() == 1
  assert np.diff(time[rows]).max() < 1.2


@pytest.mark.parametrize("travelled", [np.zeros(5), np.array([0.0, 0.0, 0.0, 0.0, 9.0])])
def test_as_many_are_chosen_as_asked_for_whatever_moves(travelled):
  rows = spread(np.arange(5), travelled, np.ones(5), 5)
  np.testing.assert_array_equal(rows, np.arange(5))
