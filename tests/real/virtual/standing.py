"""A body under torque in the standing pose."""

import numpy as np

from nerf2real.suite.op3 import constants


def stand(body, seconds):
  """Puts every goal at the standing pose, under torque, and simulates."""
  goals = np.rint(2048 + constants.standing_targets() * 4096 / (2 * np.pi)).astype(int)
  for index, counts in enumerate(goals):
    body.motors.set_goal(index, int(counts), body.time)
  body.motors.enabled[:] = True
  body.advance(body.time + seconds)
