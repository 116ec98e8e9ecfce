"""Estimates how surely cameras show which way is up: a density over directions.

A hand holds a camera level up to a roll, and looks up or down. Both have a part that all pictures
share, as a phone is held crookedly or looks down at a thing throughout, and a part of each picture.
What pictures share is known from habit alone, what differs between them from their own spread. So
cameras that look to all sides show up surely, however they pitch; pictures of a facade from before
it leave as much open as a hand's roll. The density is Student's t, as the spread itself is
estimated from few pictures. Shapes: N cameras.
"""

from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry import rotations
from nerf2real.scenes.alignment.planes import across

_CANCELLED = 0.2  # mean length of the cameras' ups below which they are rolled all ways
_HABIT = 4  # pictures that a hand's habit weighs as; chosen: three pictures say little of a spread
_ANYWHERE = np.pi / 2  # rad: deviation of up where pictures show nothing of it
_BY_HAND = np.radians(0.3)  # of an up direction that a person gave


class UpBelief(NamedTuple):
  """Density of the up direction around the likeliest one."""

  direction: np.ndarray  # unit vector [3]
  precision: np.ndarray  # [3, 3] of deviations across the direction [1/rad^2]
  freedom: float  # degrees of freedom of Student's t

  @classmethod
  def around(cls, direction: np.ndarray, deviation: float, freedom: float = 100.0) -> "UpBelief":
    """A round density about a direction [3], with a standard deviation to every side [rad]."""
    direction = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    flat = np.eye(3) - np.outer(direction, direction)
    return cls(direction, flat / deviation**2, freedom)

  def deviations(self, normals: np.ndarray) -> np.ndarray:
    """Distances [...] of unit vectors [..., 3] from the direction, in standard deviations."""
    cosine = np.clip(normals @ self.direction, -1, 1)
    aside = normals - cosine[..., None] * self.direction
    sine = np.linalg.norm(aside, axis=-1)
    aside = aside * np.where(sine > 0, np.arccos(cosine) / np.maximum(sine, 1e-12), 0)[..., None]
    return np.sqrt(np.einsum("...i,ij,...j->...", aside, self.precision, aside))

  def density(self, normals: np.ndarray) -> np.ndarray:
    """Density [...] of unit vectors [..., 3] over that of the likeliest direction."""
    return np.asarray(
      (1 + self.deviations(normals) ** 2 / self.freedom) ** (-(self.freedom + 2) / 2)
    )


def mean_up(frame_from_camera: np.ndarray) -> np.ndarray:
  """The cameras' up direction [3]: a phone is held upright, see `rotations.level_up`.

  Raises:
    ValueError: The cameras are rolled all ways.
  """
  up = -frame_from_camera[:, :3, 1].mean(0)
  length = np.linalg.norm(up)
  if length < _CANCELLED:
    raise ValueError(
      f"The cameras' up directions cancel (mean length {length:.2f}): the pictures are rolled all "
      'ways. Give "up" or "floor_points" in the override file.'
    )
  return rotations.level_up(frame_from_camera, up)


def by_hand(up: np.ndarray) -> UpBelief:
  """Up as a person gave it [3]: only the height of the floor is open."""
  return UpBelief.around(up, _BY_HAND)


def up_of_cameras(frame_from_camera: np.ndarray, up: np.ndarray | None = None) -> UpBelief:
  """How surely cameras [N, 4, 4] show up.

  An angle a . u of a camera's axis a to the level is b + e: b, of deviation s_b, is shared by all
  pictures, e, of deviation s_e, is each one's own. Then the angles' precision falls into that of
  their differences, 1 / s_e^2, and that of their mean, 1 / (s_b^2 + s_e^2 / N).

  Args:
    frame_from_camera: Poses in the order in which the pictures were taken, OpenCV's axes.
    up: The likeliest direction [3], where their axes do not show it; else `mean_up`.
  """
  up = mean_up(frame_from_camera) if up is None else np.asarray(up) / np.linalg.norm(up)
  right, forward = _level_axes(frame_from_camera, up), frame_from_camera[:, :3, 2]
  plane = across(up)
  precision, counts = np.eye(2) / _ANYWHERE**2, []
  for axes, habit in ((right, rotations.ROLL), (forward, rotations.PITCH)):
    angles = np.arcsin(np.clip(axes @ up, -1, 1))
    own = angles - angles.mean()
    count = _independent(own)
    spread = (_HABIT * habit**2 + count * np.mean(own**2)) / (_HABIT + count)
    flat = axes @ plane.T
    shared = flat.mean(0)
    precision += count / spread * np.cov(flat.T, bias=True)
    precision += np.outer(shared, shared) / (habit**2 + spread / count)
    counts.append(count)
  return UpBelief(up, plane.T @ precision @ plane, _HABIT + min(counts))


def _level_axes(frame_from_camera: np.ndarray, up: np.ndarray) -> np.ndarray:
  """The axes [N, 3] that are held level: to the right, whichever way a camera was turned."""
  forward = frame_from_camera[:, :3, 2]
  across_view = np.cross(forward, up)
  axes = np.concatenate([frame_from_camera[:, :3, :2], -frame_from_camera[:, :3, :2]], axis=-1)
  best = np.argmax(np.einsum("nia,ni->na", axes, across_view), axis=-1)
  return np.asarray(axes[np.arange(len(axes)), :, best])


def _independent(own: np.ndarray) -> float:
  """How many independent values a series [N] is worth: a film's pictures are held alike.

  N (1 - rho) / (1 + rho) of a series whose neighbours correlate by rho. Source: Bartlett 1946, On
  the theoretical specification of sampling properties of autocorrelated time series.
  """
  power = float(np.sum(own**2))
  rho = float(np.sum(own[1:] * own[:-1])) / power if power > 0 else 0.0
  rho = np.clip(rho, 0.0, 1 - 2 / (1 + len(own)))  # worth one value or more
  return len(own) * (1 - rho) / (1 + rho)
