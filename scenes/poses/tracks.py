"""Tracks of structure from motion: which keyframe sees which localised point, and where.

Shapes: O observations, N keyframes, P points.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.colmap import pycolmap


class Tracks(NamedTuple):
  """Observations of localised points, in the order of the keyframes."""

  view: np.ndarray  # row of the keyframe, int64 [O]
  point: np.ndarray  # row of the point, int64 [O]
  pixel: np.ndarray  # place in a keyframe of the localised size, float64 [O, 2]

  @classmethod
  def of_model(cls, model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> "Tracks":
    """Reads a model's tracks.

    Args:
      model: The model; its points' order is that of the rows of points.
      images: Keyframes of the model, in the order of their rows.
    """
    row = {identity: k for k, identity in enumerate(model.points3D)}
    view, point, pixel = [], [], []
    for k, image in enumerate(images):
      seen = image.get_observation_points2D()
      view += [k] * len(seen)
      point += [row[observed.point3D_id] for observed in seen]
      pixel += [observed.xy for observed in seen]
    return cls(
      np.array(view, np.int64), np.array(point, np.int64), np.array(pixel, float).reshape(-1, 2)
    )

  def of_points(self, chosen: np.ndarray) -> "Tracks":
    """Keeps the observations of chosen points, bool [P]."""
    keep = chosen[self.point]
    return Tracks(self.view[keep], self.point[keep], self.pixel[keep])

  def lengths(self, points: int) -> np.ndarray:
    """How many observations each of P points has, int64 [P]."""
    return np.bincount(self.point, minlength=points)
