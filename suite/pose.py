"""A planar pose: position and heading on the floor."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Pose(NamedTuple):
  """Where the robot is on the floor, in the scene's world frame."""

  x: float  # m
  y: float  # m
  yaw: float  # rad

  @classmethod
  def of(cls, place: Sequence[float] | np.ndarray, yaw: float) -> "Pose":
    """Returns the pose at a place [>= 2] [m] with a heading [rad]."""
    return cls(float(place[0]), float(place[1]), float(yaw))

  @property
  def xy(self) -> np.ndarray:
    """The place [2] [m]."""
    return np.array([self.x, self.y])
