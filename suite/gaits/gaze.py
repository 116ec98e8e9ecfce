"""Keeps the ball in the robot's view, low in it; pan and tilt sweep while it is not seen.

All that it does while the ball is out of view can be told from the head's own motion, so that a
policy with the same sensors can learn it: a sweep goes on where the head moves, one of a head that
rests goes to the farther side. The robot turns on the spot meanwhile, always to the left: if it
stood, a policy that is unsure whether it sees the ball would stand, too, and find nothing.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerf2real.suite.gaits.walk import Command
from nerf2real.suite.op3 import constants

_TIMESTEP = constants.CONTROL_TIMESTEP
_HEIGHT = 0.33  # m of the camera above a ball's centre: 0.45 m above the floor, less the radius
_RADIUS = 0.12  # m of the ball (paper: a basketball)
_HALF_VERTICAL = constants.CAMERA_VERTICAL_FOV / 2
_HALF_HORIZONTAL = np.arctan(4 / 3 * np.tan(_HALF_VERTICAL))  # pictures are 4:3
_LEAN = 0.08  # rad that the walking torso leans forward, and the camera with it
_PAN = 2.3  # rad at which a sweep turns back; chosen: short of the limit in ball pushing, 2.5
_REACHED = 0.1  # rad from that angle at which it does
_LEAD = 0.4  # rad that a sweep's target is ahead of the head; chosen: some 2 rad/s
# rad of a sweep to the left and to the right: balls 0.2 to 1.1 m away, and those beyond 0.4 m. A
# ball at the feet leaves the picture below, and a sweep at one height in between did not show it.
_SWEEP_TILTS = (-0.6, -0.25)
# rad below the picture's middle at which a ball is held; chosen: two thirds of the way to its edge.
# In the middle, a ball at the robot's feet would leave little but floor in the picture, which does
# not show where the robot is.
_LOW = 0.25
_LOST = 2.0  # s without a view after which the head sweeps; chosen
_RESTS = (
  0.0025  # rad in a control step below which the head rests; chosen: two of the encoder's steps
)


class View(NamedTuple):
  """A ball as the robot has it."""

  bearing: float  # rad to the left of the torso's heading
  distance: float  # m on the floor


def view_of(pose: tuple[float, float, float], ball: np.ndarray) -> View:
  """Returns where a ball [2] [m] is from a pose x [m], y [m], yaw [rad]."""
  offset = np.asarray(ball, np.float64)[:2] - np.asarray(pose[:2])
  turn = np.arctan2(offset[1], offset[0]) - pose[2]
  return View(float((turn + np.pi) % (2 * np.pi) - np.pi), float(np.hypot(*offset)))


def depression(distance: float) -> float:
  """Returns the angle [rad] below the horizon at which the camera sees a ball's centre."""
  return float(np.arctan2(_HEIGHT, max(distance, 1e-6)))


def is_seen(view: View, *, pan: float, tilt: float) -> bool:
  """Returns whether some of the ball is in the picture of a head [rad]."""
  size = float(np.arctan2(_RADIUS, np.hypot(view.distance, _HEIGHT)))
  aside = (view.bearing - pan + np.pi) % (2 * np.pi) - np.pi
  above = -depression(view.distance) - (tilt - _LEAN)
  return bool(abs(aside) < _HALF_HORIZONTAL + size / 2 and abs(above) < _HALF_VERTICAL + size / 2)


class Gaze:
  """The head's part of pushing a ball."""

  def __init__(self) -> None:
    self.reset()

  def reset(self) -> None:
    """Begins an episode: nothing has been seen."""
    self._unseen = np.inf  # s since the ball was in view

  @property
  def searches(self) -> bool:
    """Whether the ball's place is unknown."""
    return self._unseen > _LOST

  def apply(
    self, command: Command, view: View, *, pan: float, tilt: float, moved: float
  ) -> Command:
    """Returns a command with the head's part; a search turns on the spot.

    Args:
      command: What the legs shall do where the ball's place is known.
      view: Where the ball is.
      pan: The head's pan now [rad].
      tilt: And its tilt [rad].
      moved: By how much the pan has changed in the last control step [rad].
    """
    self._unseen = 0.0 if is_seen(view, pan=pan, tilt=tilt) else self._unseen + _TIMESTEP
    if not self.searches:
      bearing = float(np.clip(view.bearing, -_PAN, _PAN))
      return dataclasses.replace(command, head=(bearing, _LEAN + _LOW - depression(view.distance)))
    side = 1.0 if pan > 0 else -1.0
    at_end = abs(pan) > _PAN - _REACHED
    onward = np.sign(moved) if abs(moved) > _RESTS and not at_end else -side
    target = float(np.clip(pan + onward * _LEAD, -_PAN, _PAN))
    return Command(turn=1.0, head=(target, _SWEEP_TILTS[0 if onward > 0 else 1]))
