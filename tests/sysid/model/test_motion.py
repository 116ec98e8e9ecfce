"""Velocities from a log's readings."""

import dataclasses

import numpy as np
import pytest

from nerf2real.sysid.model.motion import start_velocity
from tests.sysid.synthetic import PENDULUM, log_of


def _log(rate: float, noise: float, speed: float):
  """A log of a joint that starts at a speed, or at rest and moves later."""
  time = np.arange(0.0, 4.0, 1.0 / rate)
  course = speed * time if speed else 0.3 * np.sin(2.0 * np.clip(time - 0.5, 0.0, None)) ** 2
  course = course + noise * np.random.default_rng(0).standard_normal(len(time))
  log = log_of(PENDULUM, "slow", duration=4.0)
  states = dataclasses.replace(log.states, stamp=time, log_time=time, position=course[:, None])
  return dataclasses.replace(log, states=states)


@pytest.mark.parametrize("rate", [50.0, 100.0, 500.0, 1000.0])
def test_noise_of_many_readings_is_no_speed(rate):
  assert start_velocity(_log(rate, 3e-4, 0.0)) == 0.0


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_a_log_that_begins_in_motion_has_its_speed(rate):
  log = _log(rate, 3e-4, 0.0)
  moving = _log(rate, 3e-4, 3.0)
  half = moving.states.position.copy()
  half[len(half) // 8 :] = half[len(half) // 8]  # it stops: the mean speed is below the first
  states = dataclasses.replace(moving.states, position=half)
  assert start_velocity(dataclasses.replace(log, states=states)) == pytest.approx(3.0, rel=0.06)


def test_readings_of_one_instant_have_no_speed():
  log = _log(100.0, 3e-4, 0.0)
  states = dataclasses.replace(log.states, stamp=np.full(2, 0.5), position=np.array([[0.0], [1.0]]))
  assert start_velocity(dataclasses.replace(log, states=states)) == 0.0
