"""Tests of the virtual OpenCR board: what it says is what the host reads."""

import numpy as np
import pytest

from nerf2real.real.virtual.bus.board import Board
from nerf2real.real.wire import opencr
from nerf2real.suite.sensors import filters


def _reading(imu):
  """Returns what the host reads of a board that feels the same for a tenth of a second."""
  board = Board(np.zeros(6), np.random.default_rng(0))
  for step in range(100):
    board.sense(step * 0.001, np.asarray(imu, np.float64), 12.0)
  error, data = board.read(opencr.MEASURED, opencr.MEASURED_LENGTH, 0.1)
  assert error == 0
  return opencr.decode(0.1, data)


@pytest.mark.parametrize(
  "imu",
  [
    (0.1, -0.2, 0.3, 1.0, -2.0, 9.81),
    (0.0, 0.0, 0.0, 0.0, -25.0, 31.0),  # a heavy step: 3 g and more
    (50.0, -50.0, 34.0, 0.0, 0.0, 9.81),
  ],
)
def test_readings_end_at_the_range_that_the_simulation_has(imu):
  found = _reading(imu)
  expected = filters.saturate(np.asarray(imu))
  assert found.gyroscope == pytest.approx(expected[:3], abs=0.0011)  # a count
  assert found.accelerometer == pytest.approx(expected[3:], abs=0.0006)
  assert found.voltage == pytest.approx(12.0)
  assert np.abs(found.accelerometer).max() <= 2 * 9.80665
