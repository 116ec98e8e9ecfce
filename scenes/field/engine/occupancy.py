"""Occupancy grids that training refines: where a march may skip empty space.

The inner grid covers the unit cube, the outer one the whole squashed space of `contraction`.
Source: Mueller et al. 2022, Instant neural graphics primitives, appendix C.
"""
# mypy: disable-error-code="valid-type"

from typing import Any

import numpy as np
import warp as wp

from nerf2real.scenes.field.engine import layout
from nerf2real.scenes.field.engine.device import OPTIONS, Device
from nerf2real.scenes.field.engine.engine import Engine
from nerf2real.scenes.field.engine.native import grid as native_grid
from nerf2real.scenes.field.settings import TrainSettings

DISTANCE_CELLS = 12  # chosen: empty space is skipped in strides of at most this many cells
_UNSEEN_DENSITY = 8.0  # chosen: density of cells before the first look [1/unit]
_SWEEP_DECAY = 0.5  # chosen: such a look weighs more than a later one's occupancy_decay
_CELL_STRIDE = 7_368_787  # a prime


@wp.func_native(native_grid.DISTANCE_ROW)
def _distance_row(
  source: wp.array(dtype=wp.uint8),
  result: wp.array(dtype=wp.uint8),
  size: wp.int32,
  limit: wp.int32,
  axis: wp.int32,
  row: wp.int32,
): ...


@wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
def distance_along(
  source: wp.array(dtype=wp.uint8),
  result: wp.array(dtype=wp.uint8),
  size: wp.int32,
  limit: wp.int32,
  axis: wp.int32,
  first: wp.int32,
):
  """One axis of the distance of grid cells [size^3] to those that are 0, up to `limit` cells.

  Run for all three axes in turn, on cells that are 0 or `limit`; a thread does a row along z.
  """
  _distance_row(source, result, size, limit, axis, first + wp.tid())


def distances(device: Device, occupied: np.ndarray, result: Any) -> None:
  """Writes the Chebyshev distance of grid cells to the nearest occupied one.

  Args:
    device: Where `result` lies.
    occupied: bool [G, G, G].
    result: Warp's uint8 [G^3]: the distances in cells, at most DISTANCE_CELLS.
  """
  device.load(distance_along)
  size = len(occupied)
  stretches = device.share(size * size)
  cells = device.put(np.where(occupied, 0, DISTANCE_CELLS).astype(np.uint8).ravel())
  for axis in range(3):
    source, target = (cells, result) if axis % 2 == 0 else (result, cells)

    def work(thread: int, source=source, target=target, axis=axis) -> None:
      first, stop = stretches[thread]
      inputs = [source, target, size, DISTANCE_CELLS, axis, first]
      device.launch(distance_along, inputs, dim=stop - first)

    device.run(work)


def cell_positions(cells: np.ndarray, size: int, jitter: np.ndarray, *, inner: bool) -> np.ndarray:
  """Points [N, 3] in the unit frame inside grid cells, at `jitter` [N, 3] in [0, 1) of the cell."""
  index = np.stack([cells // (size * size), cells // size % size, cells % size], axis=-1)
  unit = (index + jitter) / size
  if inner:
    return (2 * unit - 1).astype(np.float32)
  squashed = np.clip(4 * unit - 2, -1.98, 1.98)
  norm = np.maximum(np.abs(squashed).max(-1, keepdims=True), 1.0)
  return (squashed / (norm * (2 - norm))).astype(np.float32)


class OccupancyGrids:
  """Both grids: densities on the host, densities and distances on the device."""

  def __init__(self, settings: TrainSettings, device: Device, *, seed: int):
    """Lets every cell be occupied."""
    self._settings = settings
    self._device = device
    self._seed = seed
    self._sweep = 0  # cells looked at
    inner, outer = settings.inner_cells, settings.outer_cells
    self.inner = np.full((inner,) * 3, _UNSEEN_DENSITY, np.float32)
    self.outer = np.full((outer,) * 3, _UNSEEN_DENSITY, np.float32)
    data: Any = layout.Occupancy()
    self.data = data
    data.inner_size, data.outer_size = inner, outer
    data.inner_density = device.put(self.inner.ravel())
    data.outer_density = device.put(self.outer.ravel())
    data.inner_distance = device.zeros(inner**3, np.uint8)
    data.outer_distance = device.zeros(outer**3, np.uint8)

  def update(self, engine: Engine, step: int) -> None:
    """Looks after a step where that is due: at all cells early on, then at a part in turn."""
    settings = self._settings
    sweeping = step <= settings.occupancy_sweep_steps
    if step < settings.occupancy_start or step % (settings.occupancy_interval << sweeping):
      return
    rng = np.random.default_rng((self._seed, step))
    total = self.inner.size + self.outer.size
    count = total if sweeping else min(settings.occupancy_samples, total)
    # A stride coprime to the number of cells visits every cell once before any twice.
    cells = (self._sweep + np.arange(count)) % total * _CELL_STRIDE % total
    self._sweep = (self._sweep + count) % total
    decay = _SWEEP_DECAY if sweeping else settings.occupancy_decay
    if step < settings.occupancy_start + 2 * settings.occupancy_interval:
      decay = 0.0  # the first look replaces what was assumed
    sigma = settings.field.march_step / np.sqrt(12)
    for grid, chosen in (
      (self.inner, cells[cells < self.inner.size]),
      (self.outer, cells[cells >= self.inner.size] - self.inner.size),
    ):
      jitter = rng.random((len(chosen), 3), np.float32)
      places = cell_positions(chosen, len(grid), jitter, inner=grid is self.inner)
      seen = engine.densities(places, sigma=sigma)
      grid.ravel()[chosen] = np.maximum(grid.ravel()[chosen] * np.float32(decay), seen)
    self.refresh()

  def refresh(self) -> None:
    """Recomputes which cells are occupied and how far the others are from those."""
    settings, data = self._settings, self.data
    # Outside, a step's length grows with the distance as a cell's does: one threshold holds.
    threshold = -np.log1p(-settings.occupancy_threshold) / settings.field.march_step
    for grid, density, distance in (
      (self.inner, data.inner_density, data.inner_distance),
      (self.outer, data.outer_density, data.outer_distance),
    ):
      density.assign(grid.ravel())
      distances(self._device, grid > threshold, distance)

  def state(self) -> dict[str, np.ndarray]:
    """Returns what a later run needs to continue, by name."""
    sweep = np.array(self._sweep, np.int64)
    return {"inner_density": self.inner, "outer_density": self.outer, "sweep": sweep}

  def restore(self, arrays: dict[str, np.ndarray], *, step: int) -> None:
    """Continues after a step from what `state` returned."""
    self.inner[:] = arrays["inner_density"]
    self.outer[:] = arrays["outer_density"]
    self._sweep = int(arrays["sweep"])
    if step >= self._settings.occupancy_start:
      self.refresh()
