"""Where a field holds matter: a grid over the squashed space, and how far the next matter is.

The grid covers the contracted cube [-2, 2]^3 of `scenes.field.contraction`, index
x + G (y + G z). It is not stored: building it takes a second.
"""

import dataclasses

import numpy as np
import scipy.ndimage
import warp as wp

from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.field import Field
from nerf2real.scenes.field.render import kernels as render_kernels
from nerf2real.scenes.field.render import weights as render_weights

_MAX_DISTANCE = 255  # cells; a byte


@dataclasses.dataclass(frozen=True, kw_only=True)
class OccupancySettings:
  """Settings of the search for matter."""

  cells: int = 128
  """Cells along an axis: 8 cm in a room of 5 m. Chosen: 256 renders as fast, but takes eight times
  as long to fill."""
  density: float = 2.0
  """Density [1/unit] from which a cell counts as matter. Chosen: a cell of it hides 3 %."""
  fine_deviation: float = 0.002
  """Standard deviation [unit] of every other sample that is looked at. Chosen: a pixel near the
  camera."""
  coarse_deviation: float = 0.012
  """The same of the others. Chosen: a pixel of 30x40 pictures in the room."""

  def __post_init__(self):
    if self.cells < 4:
      raise ValueError(f"Found cells={self.cells}, expected at least 4.")


@dataclasses.dataclass(frozen=True)
class Occupancy:
  """Distance to the nearest cell with matter in cells (maximum norm), 0 in matter."""

  distance: np.ndarray
  """uint8 [G, G, G], axes z, y, x."""

  @property
  def cells(self) -> int:
    """Cells along an axis, G."""
    return self.distance.shape[0]

  @classmethod
  def from_occupied(cls, occupied: np.ndarray) -> "Occupancy":
    """Builds the distance from a grid of cells with matter, bool [G, G, G], axes z, y, x."""
    occupied = np.asarray(occupied, bool)
    if occupied.ndim != 3 or len(set(occupied.shape)) != 1:
      raise ValueError(f"Expected a cube of cells [G, G, G], found shape {occupied.shape}.")
    if not occupied.any():
      return cls(np.full(occupied.shape, _MAX_DISTANCE, np.uint8))
    cells = scipy.ndimage.distance_transform_cdt(~occupied, metric="chessboard")
    return cls(np.minimum(cells, _MAX_DISTANCE).astype(np.uint8))


def build(
  field: Field, *, settings: OccupancySettings | None = None, device: Device | None = None
) -> Occupancy:
  """Finds a field's matter: cells that are dense at a corner or at their centre.

  Every cell is looked at: to search coarser cells first misses what stands by itself and is
  thinner than the distance between their points, such as a table.

  Args:
    field: A trained field.
    settings: How finely to look.
    device: Where to look; the CPU if None.

  Returns:
    The occupancy over the squashed space.
  """
  settings = settings or OccupancySettings()
  device = device or Device(threads=1)
  packed = render_weights.pack(field.settings, field.params)
  kernel = render_kernels.build(packed.layout).density
  data = render_kernels.upload(packed, field.settings.march_step, device)
  deviations = wp.vec2(settings.fine_deviation, settings.coarse_deviation)

  def dense(side: int, offset: float) -> np.ndarray:
    """Whether matter is at a lattice's points, bool [side, side, side], axes z, y, x."""
    found = device.zeros(side**3)
    inputs = [data, side, 1 / settings.cells, offset, deviations, found]
    device.launch(kernel, inputs, dim=side**3)
    matter: np.ndarray = found.numpy().reshape((side,) * 3) > settings.density
    return matter

  corners = dense(settings.cells + 1, 0.0)
  for axis in range(3):
    first, second = (np.delete(corners, row, axis) for row in (-1, 0))
    corners = first | second
  return Occupancy.from_occupied(corners | dense(settings.cells, 0.5))
