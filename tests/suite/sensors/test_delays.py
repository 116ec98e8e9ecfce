"""Delay lines: arrival times, jitter, interpolation, steps back."""

import numpy as np
import pytest

from nerf2real.suite.sensors.delays import DelayLine, History, StepRing


def test_delay_without_jitter_is_exact():
  line = DelayLine(0.03)
  for step in range(40):
    line.push(step * 0.005, np.array([float(step)]))
    assert line.read(step * 0.005)[0] == max(0, step - 6)


def test_delay_and_jitter_statistics():
  line = DelayLine(capacity=512)
  line.reset(0.03, jitter=0.005, rng=np.random.default_rng(1))
  # Samples far apart compared with the jitter: the first time a sample can be read is its arrival.
  line.push(0.0, np.array([0]))
  arrivals = []
  for sample in range(1, 400):
    start = sample * 0.1
    line.push(start, np.array([sample]))
    clock = start + np.arange(0.02, 0.04, 1e-4)
    seen = [t for t in clock if line.read(t)[0] == sample]
    arrivals.append(seen[0] - start)
  assert min(arrivals) >= 0.025 and max(arrivals) <= 0.0351
  assert np.mean(arrivals) == pytest.approx(0.03, abs=5e-4)
  # Uniform of half width 5 ms: standard deviation 5 / sqrt(3) = 2.89 ms.
  assert np.std(arrivals) == pytest.approx(0.00289, abs=2.5e-4)


def test_jitter_never_goes_back_in_time():
  line = DelayLine()
  line.reset(0.02, jitter=0.01, rng=np.random.default_rng(2))
  seen = []
  for step in range(500):
    line.push(step * 0.004, np.array([step]))
    seen.append(int(line.read(step * 0.004)[0]))
    if step > 10:
      age = (step - seen[-1]) * 0.004
      assert 0.01 - 1e-9 <= age <= 0.034 + 1e-9
  assert (np.diff(seen) >= 0).all()


def test_delay_line_before_the_first_push():
  with pytest.raises(ValueError, match="push"):
    DelayLine(0.01).read(0.0)


def test_history_interpolates_as_numpy_does():
  rng = np.random.default_rng(4)
  history, times = History(16), np.cumsum(rng.uniform(0.001, 0.01, 40))
  values = rng.normal(size=(40, 3))
  for time, value in zip(times, values, strict=True):
    history.push(time, value)
  kept = slice(40 - 16, 40)
  for time in [*np.linspace(times[0], times[-1] + 0.1, 200), times[30]]:
    expected = [np.interp(time, times[kept], column) for column in values[kept].T]
    np.testing.assert_allclose(history.interpolate(time), expected, atol=1e-12)


def test_history_of_a_repeated_time_keeps_the_last_sample():
  history = History()
  for time, value in ((0.0, 1.0), (1.0, 2.0), (1.0, 3.0)):
    history.push(time, np.array([value]))
  assert history.count == 2 and history.last_time == 1.0
  assert history.newest(1.0) == 3.0 and history.newest(0.9) == 1.0 and history.newest(-1.0) == 1.0
  assert history.interpolate(0.5) == 2.0
  history.clear()
  assert history.last_time == -np.inf
  with pytest.raises(ValueError, match="push"):
    history.interpolate(0.0)


def test_step_ring_goes_back_by_steps():
  ring = StepRing(4, 2)
  ring.fill(np.array([0.0, 10.0]))
  for step in range(1, 7):
    ring.push(np.array([step, 10.0 + step]))
    np.testing.assert_array_equal(ring.back(0), [step, 10 + step])
    np.testing.assert_array_equal(ring.back(3), [max(0, step - 3), 10 + max(0, step - 3)])
    assert ring.back_each(np.array([1, 3])).tolist() == [step - 1, 10 + max(0, step - 3)]
