"""A marker as the landmark of the world frame: the same frame in every film of a room.

Without it the origin is the middle of the extent, which differs by some 10 cm between two films of
the same room, and the axes are the walls'. A marker that stays where it lies is a landmark in the
room itself: places on the map (goals, a robot's start) can be measured from it with a rule.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nerf2real.core.geometry.similarity import Similarity

if TYPE_CHECKING:  # a robot reads places without what finds markers
  from nerf2real.scenes.alignment.markers import MarkerScale


class MarkerPlace(NamedTuple):
  """Where a marker lies on the map."""

  x: float
  """Its centre, world frame [m]."""
  y: float
  """Its centre, world frame [m]."""
  heading_deg: float
  """Of its upper edge, from the upper left corner as printed to the upper right, from the x axis,
  counterclockwise as seen from above."""

  @property
  def words(self) -> str:
    """The place as a sentence for who measures from it."""
    return (
      f"The marker lies at x = {self.x:.2f} m, y = {self.y:.2f} m, its upper edge heading "
      f"{self.heading_deg:.0f} degrees from the x axis."
    )


def upper_edge(marker: "MarkerScale", upright: np.ndarray) -> float:
  """Heading [rad] of the first marker's upper edge about the z axis.

  Args:
    marker: With corners in the unit frame.
    upright: Rotation [3, 3] from the unit frame to one whose z axis is up.
  """
  left, right = marker.corners[0, 0], marker.corners[0, 1]
  along = upright @ (right - left)
  return float(np.arctan2(along[1], along[0]))


def place_of(marker: "MarkerScale", world_from_unit: Similarity) -> MarkerPlace:
  """Returns where the first marker lies in a world frame."""
  x, y, _ = world_from_unit.apply(marker.corners[0].mean(0))
  heading = np.degrees(upper_edge(marker, world_from_unit.rotation))
  return MarkerPlace(float(x), float(y), float(heading))
