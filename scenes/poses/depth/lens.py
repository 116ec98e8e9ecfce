"""The lens that all pictures share, and how what they see changes with it.

Shapes: K cells, L numbers of the lens.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from nerf2real.core.geometry.cameras import LENS, Camera

_STEPS = (0.5, 0.5, 0.5, 0.5, 1e-3, 1e-3, 1e-4, 1e-4)  # of differences
_OFF = (0.02, 0.02, 0.02, 0.02, 0.1, 0.1, 0.01, 0.01)  # what they may be; four in focal lengths


@dataclasses.dataclass(frozen=True)
class Grid:
  """Where the cells of a depth picture look."""

  camera: Camera
  """Of the cells."""
  rays: np.ndarray
  """[H * W, 3], of one metre's depth."""
  by_lens: np.ndarray
  """Their derivatives [H * W, 3, L]."""

  @classmethod
  def of(cls, camera: Camera, height: int, width: int) -> "Grid":
    """Returns the grid of so many cells of a camera's pictures."""
    small = camera.resized(width, height)
    pixels = small.pixel_centres() * [camera.width / width, camera.height / height]
    pixels = pixels.reshape(-1, 2)
    return cls(small, camera.rays(pixels), rays_by_lens(camera, pixels))


def off(camera: Camera, nominal: Camera) -> tuple[np.ndarray, np.ndarray]:
  """Returns how far [L] a lens is from a nominal one, in the deviations [L] that it may have."""
  size = np.array([nominal.fx, nominal.fy, nominal.fx, nominal.fy, 1.0, 1.0, 1.0, 1.0])
  moved = np.array([getattr(camera, name) - getattr(nominal, name) for name in LENS])
  return moved / (size * _OFF), size * _OFF


def with_lens(camera: Camera, by: np.ndarray) -> Camera:
  """Returns a camera whose lens differs by numbers [L]."""
  moved: dict[str, Any] = {
    name: getattr(camera, name) + float(d) for name, d in zip(LENS, by, strict=True)
  }
  return dataclasses.replace(camera, **moved)


def rays_by_lens(camera: Camera, pixels: np.ndarray) -> np.ndarray:
  """Returns derivatives [..., 3, L] of the rays at pixels [..., 2] by the lens."""
  return _by_lens(camera, lambda moved: moved.rays(pixels))


def pixels_by_lens(camera: Camera, points: np.ndarray) -> np.ndarray:
  """Returns derivatives [..., 2, L] of where points [..., 3] are seen by the lens."""
  return _by_lens(camera, lambda moved: moved.project(points))


def _by_lens(camera: Camera, function: Callable[[Camera], np.ndarray]) -> np.ndarray:
  parts = []
  for step in np.diag(_STEPS):
    ahead, behind = (function(with_lens(camera, sign * step)) for sign in (1.0, -1.0))
    parts.append((ahead - behind) / (2.0 * step.max()))
  return np.stack(parts, axis=-1)
