"""A gear with play: rotor and arm touch at either flank of the teeth.

Source: Nordin and Gutman 2002, Controlling mechanical systems with backlash, section 2.
"""

from typing import NamedTuple

import numba


class Gear(NamedTuple):
  """Constants at the output shaft."""

  rotor: float
  """kg m^2, of motor and gear wheels, seen from the output."""
  play: float
  """rad, full width of the gap."""
  stiffness: float
  """N m/rad, of the closed teeth."""
  damping: float
  """N m s/rad, of the closed teeth."""


@numba.njit
def teeth(gear: Gear, offset: float, rate: float) -> float:
  """Returns the torque [N m] on the arm; teeth push and never pull.

  Args:
    gear: constants.
    offset: rotor's angle minus the arm's, rad.
    rate: its rate, rad/s.
  """
  half = 0.5 * gear.play
  if offset > half:
    return max(gear.stiffness * (offset - half) + gear.damping * rate, 0.0)
  if offset < -half:
    return min(gear.stiffness * (offset + half) + gear.damping * rate, 0.0)
  return 0.0
