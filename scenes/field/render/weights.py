"""Packs a field's parameters the way the render kernels read them.

The hash table becomes pairs of 16-bit integers in one word an entry (half of the cache misses of
float32; the error is 1/65534 of a level's largest feature), with the scales folded into the first
layer; dense levels keep only the entries they use; the layer norm's mean is folded into the second.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from nerf2real.scenes.field import encoding

_LANES = 8  # levels are padded to a multiple of the lanes of a 256-bit vector
_OUTPUT_LANES = 16  # the base network's outputs are padded to a 512-bit vector
_LEVEL_ROWS = 5  # offset, and the rows of encoding.level_rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class Layout:
  """Every number that is compiled into the kernels."""

  padded_levels: int
  width: int
  outputs: int
  """1 density, 3 diffuse, bottleneck, padding."""
  bottleneck: int
  view_width: int
  density_scale: float


class Packed(NamedTuple):
  """A field's parameters for the kernels."""

  layout: Layout
  table: np.ndarray  # uint32 [entries of all levels]: two int16 an entry
  levels: np.ndarray  # uint32 [5 * padded levels]
  base: np.ndarray  # float32, see scenes.field.render.native
  view: np.ndarray  # float32, see scenes.field.render.native


def _padded(count: int, multiple: int) -> int:
  return -(-count // multiple) * multiple


def _quantise(level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Rounds features [T, 2] to int16; returns words uint32 [T] and scales [2]."""
  largest = np.abs(level).max(0)
  scale = np.where(largest > 0, largest, 1.0) / 32767.0
  whole = np.round(level / scale).astype(np.int16)
  return np.ascontiguousarray(whole).view(np.uint32)[:, 0], scale


def pack(settings: Any, params: Any) -> Packed:
  """Packs the parameters of a field.

  Args:
    settings: The field's `FieldSettings`.
    params: Its parameters by name.

  Raises:
    ValueError: Where the kernels do not support the field's shape.
  """
  if settings.features != 2 or settings.width % 4:
    raise ValueError(
      f"The renderer reads 2 features an entry and a width divisible by 4, found "
      f"{settings.features} and {settings.width}: train the field with such settings."
    )
  array = {name: np.asarray(params[name], np.float64) for name in settings.shapes}
  count = settings.levels
  padded = _padded(count, _LANES)
  entries = 2**settings.log2_table_size
  rows = np.zeros((_LEVEL_ROWS, padded), np.uint32)
  rows[4] = 1
  rows[1:, :count] = encoding.level_rows(settings.resolutions, entries)
  words, offset = [], 0
  w1 = array["base_w1"]
  first = np.zeros((padded, settings.width))
  second = np.zeros((padded, settings.width))
  for level, cells in enumerate(settings.resolutions):
    used = (cells + 1) ** 3 if encoding.is_dense(cells, entries) else entries
    rows[0, level] = offset
    level_words, scale = _quantise(array["table"][level, :used])
    words.append(level_words)
    offset += used
    first[level] = w1[2 * level] * scale[0]
    second[level] = w1[2 * level + 1] * scale[1]

  outputs = 4 + settings.bottleneck
  lanes = _padded(outputs, _OUTPUT_LANES)
  w2 = np.zeros((settings.width + 1, lanes))
  w2[:-1, :outputs] = array["base_w2"] - array["base_w2"].mean(0)
  w2[-1, :outputs] = array["base_b2"]
  w2[:, 0] *= settings.density_gain
  w2[-1, 0] += settings.density_bias
  base = [array["base_b1"], w1[2 * count :], first, second, w2]
  bottleneck, harmonics = np.split(array["view_w1"], [settings.bottleneck])
  specular = array["view_b2"] + settings.specular_bias
  view = [array["view_b1"], harmonics, bottleneck, array["view_w2"].T, specular]
  layout = Layout(
    padded_levels=padded,
    width=settings.width,
    outputs=lanes,
    bottleneck=settings.bottleneck,
    view_width=settings.view_width,
    density_scale=float(settings.density_scale),
  )
  return Packed(
    layout=layout,
    table=np.concatenate(words),
    levels=rows.ravel(),
    base=np.concatenate([part.ravel() for part in base]).astype(np.float32),
    view=np.concatenate([part.ravel() for part in view]).astype(np.float32),
  )
