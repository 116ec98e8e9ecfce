"""The light on what moves in a robot's picture: the room's own light is in its radiance field.

A bundle holds no lamps, so what a ball or a hand looks like in the room is not known: it can be
fixed, or drawn for every episode. Shape letter: K surface points.
"""

from typing import NamedTuple

import numpy as np

_UP = np.array([0.0, 0.0, 1.0])
# Ranges of drawn light. Chosen: from a dim room to one in which a surface is overexposed, with a
# lamp anywhere above, and a camera's white balance as far off as the pictures' augmentation goes.
_AMBIENT_RANGE = (0.3, 0.9)
_LAMP_RANGE = (0.0, 0.8)
_MAX_SLANT = np.deg2rad(60)  # of the lamp's direction against the vertical
_MAX_TINT = 0.15


class Light(NamedTuple):
  """Light from everywhere and from one distant lamp."""

  ambient: float
  """Share of a surface's colour that is seen in the shade."""
  lamp: float
  """Share that the lamp adds to a surface that faces it."""
  direction: np.ndarray
  """Unit vector towards the lamp in the world [3]."""
  tint: np.ndarray
  """Factors on red, green and blue [3]."""

  def on(self, normals: np.ndarray) -> np.ndarray:
    """Returns the factors [K, 3] on the colours of surfaces with unit normals [K, 3] (Lambert)."""
    shades = self.ambient + self.lamp * np.maximum(normals @ self.direction, 0.0)
    return shades[:, None] * self.tint


FIXED = Light(0.5, 0.5, np.array([0.3, 0.2, 0.933]), np.ones(3))
"""A lamp above; chosen."""


def draw_light(rng: np.random.Generator | np.random.RandomState) -> Light:
  """Draws a light."""
  slant, around = rng.uniform(0.0, _MAX_SLANT), rng.uniform(0.0, 2 * np.pi)
  aside = np.array([np.cos(around), np.sin(around), 0.0])
  return Light(
    ambient=float(rng.uniform(*_AMBIENT_RANGE)),
    lamp=float(rng.uniform(*_LAMP_RANGE)),
    direction=np.cos(slant) * _UP + np.sin(slant) * aside,
    tint=1.0 + rng.uniform(-_MAX_TINT, _MAX_TINT, size=3),
  )
