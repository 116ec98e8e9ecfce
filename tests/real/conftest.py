"""A virtual robot on a stepped clock, standing or not, for the tests of `real`."""

import dataclasses

import pytest

from nerf2real import real
from nerf2real.real.loop.settings import RobotSettings
from nerf2real.real.safety.monitor import SafetySettings
from nerf2real.real.virtual.hidden import Hidden
from nerf2real.real.virtual.robot import VirtualRobot


class Picture:
  """A camera whose picture and age a test sets."""

  def __init__(self, clock, shape=(60, 80, 3)):
    import numpy as np

    self.clock, self.taken, self.follows = clock, clock.now(), True
    self.picture = np.zeros(shape, np.uint8)
    self.error = None
    self.closed = False

  def read(self):
    if self.error is not None:
      raise self.error
    if self.follows:
      self.taken = self.clock.now() - 0.03
    return self.picture, self.clock.now() - self.taken

  def close(self):
    self.closed = True


@pytest.fixture
def robot():
  with VirtualRobot(stepped=True, hidden=Hidden.none()) as found:
    yield found


@pytest.fixture
def quick():
  """Settings whose waits and slow moves are short."""
  safety = SafetySettings(slow_speed=2.0)
  return RobotSettings(settle_time=0.9, grip_time=0.1, safety=safety)


@pytest.fixture
def load(robot, quick):
  """Loads an environment on the virtual robot; closes it afterwards."""
  opened = []

  def make(*, pictures=None, **arguments):
    own = {key: arguments.pop(key) for key in ("offsets", "lens") if key in arguments}
    connection = dataclasses.replace(robot.connection(), camera=pictures, **own)
    arguments.setdefault("image_size", None if pictures is None else (30, 40))
    arguments.setdefault("settings", quick)
    environment = real.load("nerf_nav", robot=connection, **arguments)
    opened.append(environment)
    return environment

  yield make
  for environment in opened:
    environment.close()


@pytest.fixture
def picture(robot):
  return Picture(robot.clock)
