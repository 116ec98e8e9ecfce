"""Fields whose matter is known in closed form, made by writing a distance into the hash grid."""

import dataclasses
from collections.abc import Callable

import numpy as np

from nerf2real.scenes.field.encoding import is_dense
from nerf2real.scenes.field.field import Field, FieldSettings

_GAIN = 3.0  # the layer norm makes +-8 of the feature's sign; times this it is the raw density


def from_grid_coordinates(coordinates: np.ndarray) -> np.ndarray:
  """Inverts `contraction.grid_coordinates` for points [..., 3] strictly inside [0, 1]^3."""
  squashed = coordinates * 4.0 - 2.0
  norm = np.maximum(np.abs(squashed).max(axis=-1, keepdims=True), 1.0)
  return squashed / (norm * (2.0 - norm))


def from_signed_distance(
  signed_distance: Callable[[np.ndarray], np.ndarray],
  *,
  settings: FieldSettings | None = None,
  slope: float = 40.0,
  texture: float = 0.0,
  seed: int = 0,
) -> Field:
  """A field that is dense where the signed distance is negative.

  Args:
    signed_distance: Maps points [..., 3] of the unit frame to distances [...], positive outside.
    settings: The shape; its finest dense level carries the distance. The density is 10 squareplus.
    slope: Feature per unit of distance; small ones make a soft surface where there is texture.
    texture: Amplitude of random features on all levels and of random colour weights.
    seed: Of the random numbers.
  """
  settings = settings or FieldSettings(
    levels=2, log2_table_size=15, base_resolution=31, growth=1.0001
  )
  settings = dataclasses.replace(settings, density_gain=1.0, density_scale=10.0)
  random = np.random.default_rng(seed)
  params = {
    name: (texture * random.normal(size=shape)).astype(np.float32)
    for name, shape in settings.shapes.items()
  }
  entries = 2**settings.log2_table_size
  level = max(i for i, cells in enumerate(settings.resolutions) if is_dense(cells, entries))
  cells = settings.resolutions[level]
  z, y, x = np.meshgrid(*[np.arange(cells + 1) / cells] * 3, indexing="ij")
  inner = np.clip(np.stack([x, y, z], -1), 0.01, 0.99)
  distance = signed_distance(from_grid_coordinates(inner))
  params["table"][level, : (cells + 1) ** 3, 0] = -slope * distance.ravel()
  feature = level * settings.features
  # swish(x) - swish(-x) = x, and the layer norm turns it into its sign.
  params["base_w1"][feature] = 0
  params["base_w1"][:, :2] = 0
  params["base_w1"][feature, :2] = 1, -1
  params["base_b1"][:2] = 0
  params["base_w2"][:2] = 0
  params["base_w2"][:, 0] = 0
  params["base_w2"][:2, 0] = _GAIN, -_GAIN
  params["base_b2"][0] = 0
  return Field(settings, params, 0.002)
