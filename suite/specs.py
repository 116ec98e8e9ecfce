"""Specifications of observations and actions, the same in simulation and on the robot."""

import collections

import numpy as np
from dm_env import specs

from nerf2real.suite.op3 import constants

HISTORY = 5  # control steps (paper: "a history of past 5 proprioceptive observations")

_JOINTS = len(constants.JOINT_NAMES)
# Reading: (size, largest magnitude or None). Units: rad/s, m/s^2, unit vector, rad, normalised.
PROPRIOCEPTION: dict[str, tuple[int, float | None]] = {
  "gyroscope": (3, None),
  "accelerometer": (3, None),
  "gravity": (3, 1.0),
  "joint_positions": (_JOINTS, None),
  "previous_control": (_JOINTS, 1.0),
}


def action_spec() -> specs.BoundedArray:
  """Position targets of the joints [20], normalised: -1 is the lower limit, 1 the upper."""
  return specs.BoundedArray(
    (_JOINTS,), np.float32, -1.0, 1.0, name="\t".join(constants.JOINT_NAMES)
  )


def policy_observation_spec(
  *, goal_lower: np.ndarray, goal_upper: np.ndarray, image_shape: tuple[int, int, int] | None
) -> "collections.OrderedDict[str, specs.Array]":
  """Returns the specifications of what a policy observes.

  Args:
    goal_lower: Lower corner of the scene's floor [2] [m].
    goal_upper: Upper corner [2] [m].
    image_shape: (H, W, 3); None for a policy without a camera.
  """
  found: collections.OrderedDict[str, specs.Array] = collections.OrderedDict()
  for name, (size, bound) in PROPRIOCEPTION.items():
    shape = (HISTORY, size)
    found[name] = (
      specs.Array(shape, np.float32, name=name)
      if bound is None
      else specs.BoundedArray(shape, np.float32, -bound, bound, name=name)
    )
  found["goal"] = specs.BoundedArray(
    (2,), np.float32, np.float32(goal_lower), np.float32(goal_upper), name="goal"
  )
  if image_shape is not None:
    found["camera"] = specs.BoundedArray(image_shape, np.uint8, 0, 255, name="camera")
  return found
