"""Tests of the clocks."""

import time

import pytest

from nerf2real.real.clock import RealClock, SteppedClock


def test_stepped_work_runs_at_its_times_in_order():
  clock = SteppedClock()
  seen = []
  clock.every(0.008, lambda: seen.append(("a", round(clock.now(), 6))), name="a")
  clock.every(0.025, lambda: seen.append(("b", round(clock.now(), 6))), name="b")
  clock.sleep_until(0.026)
  assert [t for n, t in seen if n == "a"] == [0.0, 0.008, 0.016, 0.024]
  assert [t for n, t in seen if n == "b"] == [0.0, 0.025]
  assert [t for _, t in seen] == sorted(t for _, t in seen)
  assert clock.now() == pytest.approx(0.026)


def test_stepped_work_that_takes_too_long_misses_periods():
  clock = SteppedClock()
  job = clock.every(0.008, lambda: clock.advance(clock.now() + 0.020), name="slow")
  clock.sleep_until(0.1)
  assert job.missed > 0
  job.stop()
  now = clock.now()
  clock.sleep_until(now + 1.0)
  assert clock.now() == pytest.approx(now + 1.0)


def test_real_work_runs_about_as_often_as_asked():
  clock = RealClock()
  times = []
  begun = clock.now()
  job = clock.every(0.01, lambda: times.append(clock.now()), name="work")
  time.sleep(0.3)
  job.stop()
  periods = (clock.now() - begun) / 0.01  # a loaded machine sleeps longer
  count = len(times)
  assert count >= 5 and count + job.missed <= periods + 2
  time.sleep(0.05)
  assert len(times) == count


def test_real_time_is_that_of_the_machine():
  clock = RealClock()
  before = time.time()
  assert before - 0.001 <= clock.wall(clock.now()) <= time.time() + 0.001
  start = time.monotonic()
  clock.sleep_until(clock.now() + 0.05)
  assert time.monotonic() - start >= 0.049
