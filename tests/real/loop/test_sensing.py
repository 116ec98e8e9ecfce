"""Tests of the way from readings to observations: the gyroscope's zero."""

import dataclasses

import numpy as np
import pytest

from nerf2real import real
from nerf2real.real.loop.sensing import Sensing
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.robot import VirtualRobot
from nerf2real.real.wire.opencr import ImuReading

UP = np.array([0.0, 0.0, 9.81])
BIAS = np.array([0.02, -0.015, 0.01])  # rad/s


def _feed(sensing, rates, *, start=0.0):
  """Feeds turning rates [N, 3] at 125 Hz; returns the last direction of gravity."""
  gravity = None
  for index, rate in enumerate(rates):
    gravity = sensing.take_imu(ImuReading(start + 0.008 * index, rate, UP, 12.0))
  return gravity


def _noise(count):
  return np.random.default_rng(0).normal(0, 0.003, (count, 3))


def test_zero_is_what_a_still_gyroscope_reads():
  sensing = Sensing()
  sensing.begin_rest()
  _feed(sensing, BIAS + _noise(125))
  assert sensing.end_rest()
  assert sensing.zero == pytest.approx(BIAS, abs=0.001)
  _feed(sensing, [BIAS + np.array([0.5, 0, 0])], start=2.0)
  assert sensing._imu[1] == pytest.approx([0.5, 0, 0], abs=0.001)


def test_gravity_does_not_drift_with_the_zero_taken():
  """The accelerometer is left out (free fall): only the gyroscope is integrated."""
  ends = []
  for zeroed in (False, True):
    sensing = Sensing()
    sensing.begin_rest()
    _feed(sensing, BIAS + _noise(125))
    if zeroed:
      assert sensing.end_rest()
    for index in range(1250):  # 10 s
      gravity = sensing.take_imu(ImuReading(1 + 0.008 * index, BIAS, np.zeros(3), 12.0))
    ends.append(np.rad2deg(np.arccos(-gravity[2])))
  assert ends[0] == pytest.approx(np.rad2deg(10 * np.hypot(*BIAS[:2])), rel=0.1)  # 14 degrees
  assert ends[1] < 0.7


@pytest.mark.parametrize(
  "rates",
  [
    0.2 * np.sin(np.linspace(0, 20, 125))[:, None] * np.ones(3),  # swaying
    np.tile([0.0, 0.0, 0.4], (125, 1)),  # turned steadily
    _noise(5),  # hardly read
  ],
)
def test_a_moving_robot_keeps_its_old_zero(rates):
  sensing = Sensing()
  sensing.begin_rest()
  _feed(sensing, np.tile(BIAS, (50, 1)))
  assert sensing.end_rest()
  sensing.begin_rest()
  _feed(sensing, rates, start=1.0)
  assert not sensing.end_rest()
  assert sensing.zero == pytest.approx(BIAS)


def test_the_environment_measures_it_while_the_robot_stands(quick):
  hidden = dataclasses.replace(Hidden.none(), gyroscope_bias=tuple(BIAS))
  with VirtualRobot(stepped=True, hidden=hidden) as robot:
    settings = dataclasses.replace(quick, settle_time=2.0)
    with real.load(
      "nerf_nav", robot=robot.connection(), image_size=None, settings=settings
    ) as environment:
      timestep = environment.reset()
      for _ in range(8):
        timestep = environment.step(environment.standing_action)
      assert timestep.observation["gyroscope"].mean(axis=0) == pytest.approx(np.zeros(3), abs=0.006)
