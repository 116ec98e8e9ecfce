"""Dry friction of a transmission: Maxwell slip, elements that stick until they slip.

Source: Al-Bender, Lampaert, Swevers 2005, "The generalized Maxwell-slip model", with an attraction
to the Stribeck curve that is immediate. Forces are in a joint's unit, N m or N.
"""

import math

import numba
import numpy as np

SHARES = np.array([0.2, 0.3, 0.3, 0.2])
"""Of the whole force that each element gives when it slips; they sum to 1."""
REACHES = np.array([0.25, 0.75, 1.5, 3.0])
"""Of the scale of presliding, after which each element slips."""


@numba.njit(cache=True)
def stribeck(speed: float, breakaway: float, velocity: float) -> float:
  """Returns what friction has beyond that in motion: breakaway exp(-(speed / velocity)^2)."""
  ratio = speed / velocity
  return breakaway * math.exp(-ratio * ratio)


@numba.njit(cache=True)
def slip(forces: np.ndarray, moved: float, healthy: float, reach: float, limit: float) -> float:
  """Advances the elements by a motion and returns the force against it.

  Args:
    forces: of the elements [K], changed in place.
    moved: rad or m since the last call.
    healthy: friction that makes the elements' stiffness: shares healthy / (reaches reach).
    reach: scale of presliding, rad or m.
    limit: friction at the present speed.
  """
  total = 0.0
  for i in range(forces.size):
    most = SHARES[i] * limit
    force = forces[i] + SHARES[i] * healthy / (REACHES[i] * reach) * moved
    forces[i] = min(max(force, -most), most)
    total += forces[i]
  return total
