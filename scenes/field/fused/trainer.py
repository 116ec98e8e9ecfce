"""Training and rendering of a field on CPU cores with the fused numba kernels.

`FusedTrainer` owns the parameters, the optimiser's moments and the occupancy; one call of `step` is
one step of AdamW. `FusedField` evaluates a trained field: pictures, distances, densities on a grid.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

from nerf2real.core.cameras import Camera
from nerf2real.scenes.field.field import Field, init_params
from nerf2real.scenes.field.fused import grid as fused_grid
from nerf2real.scenes.field.fused import kernels as fused_kernels
from nerf2real.scenes.field.fused.engine import (
  Engine,
  check_supported,
  flatten,
  full_occupancy,
  kernel_settings,
  make_chunk,
  make_pictures,
  network_arrays,
  num_threads,
  refresh,
  unflatten,
)
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import Views

_CHUNK_SAMPLES = 768  # ours: a thread's activations stay in a second-level cache of 1 MB
_UNSEEN_DENSITY = 8.0  # ours: density of cells before the first look [1/unit]
_SWEEP_DECAY = 0.5  # ours: such a look weighs more than a later one's occupancy_decay
_COARSEST = 8  # ours: the first marches take steps of 16 cm in a room of 5 m
_COARSEN_RATIO = 5  # ours: above 2, so that the march does not go back and forth
_CELL_STRIDE = 7_368_787  # a prime


class FusedTrainer:
  """A training run: parameters, moments, occupancy; `step` improves them."""

  def __init__(
    self, views: Views, settings: TrainSettings, *, seed: int, initial: Field | None = None
  ):
    check_supported(settings.field)
    self.settings = settings
    self.seed = seed
    self.steps_done = 0
    self.rays_done = 0
    self.samples_done = 0
    field = settings.field
    params = initial.params if initial else init_params(jax.random.PRNGKey(seed), field)
    self.table = np.array(params["table"], np.float32).ravel()
    self.flat = flatten(field, params)
    self.moments = [np.zeros_like(x) for x in (self.table, self.table, self.flat, self.flat)]
    self.gradient = np.zeros_like(self.table)
    self.pixel_angle = views.camera.pixel_angle
    self.pictures = make_pictures(views, blur_max=settings.blur_max)
    threads = num_threads()
    self._budget = settings.batch_samples // threads
    stored = self._budget + 2 * _CHUNK_SAMPLES
    self._gradients = [np.zeros_like(self.flat) for _ in range(threads)]
    self._gradient_networks = [network_arrays(field, g) for g in self._gradients]
    network = network_arrays(field, self.flat)
    refresh(field, network)
    self.engine = Engine(
      field,
      kernel_settings(field, self.pixel_angle, settings),
      self.table,
      network,
      full_occupancy(settings.inner_cells, settings.outer_cells, _UNSEEN_DENSITY),
      [make_chunk(field, samples=_CHUNK_SAMPLES, stored=stored) for _ in range(threads)],
      ThreadPoolExecutor(threads),
    )
    self._levels = [
      [level for level in range(field.levels) if level % threads == t] for t in range(threads)
    ]
    self._last_known_step = settings.last_known_step(uneven=views.uneven)
    self._sweep = 0
    self._coarseness = 1 if initial else _COARSEST  # the march's step in units of the field's

  def prepare(self) -> None:
    """Compiles the kernels without changing anything."""
    engine, settings = self.engine, self.settings
    nothing, figures = np.zeros(0, np.float32), np.zeros(6)
    resolutions, entries = engine.resolutions, engine.entries
    fused_kernels.train_rays(
      self.pictures,
      engine.kernel,
      engine.occupancy,
      engine.network,
      self._gradient_networks[0],
      self.table,
      resolutions,
      entries,
      engine.chunks[0],
      np.uint64(0),
      0,
      0,
      np.float32(0),
      figures,
    )
    fused_grid.scatter_level(self.gradient, 0, resolutions[0], entries, nothing, 0, nothing, 1)
    fused_grid.adam(
      nothing,
      nothing,
      nothing,
      nothing,
      0,
      0,
      0.0,
      0.0,
      settings.adam_beta1,
      settings.adam_beta2,
      settings.adam_epsilon,
      1,
    )
    engine.densities(np.zeros((0, 3), np.float32), sigma=0.0)

  def step(self, learning_rate: float) -> dict[str, float]:
    """Makes one step; returns rays, samples, psnr_db, charbonnier and distortion of its batch."""
    engine, settings = self.engine, self.settings
    threads = len(engine.chunks)
    kernel = engine.kernel._replace(step=np.float32(engine.settings.march_step * self._coarseness))
    if self.steps_done < settings.occupancy_start:
      kernel = kernel._replace(depth_limit=np.float32(1e9))
    if self.steps_done >= self._last_known_step:
      kernel = kernel._replace(anchor_fraction=np.float32(0), empty_samples=0)
    distortion = settings.distortion_weight * settings.distortion_ramp(self.steps_done)
    kernel = kernel._replace(distortion=np.float32(distortion))
    seed = np.uint64((self.seed * 1_000_003 + self.steps_done) & (2**63 - 1))
    figures = np.zeros((threads, 6))
    resolutions, entries = engine.resolutions, engine.entries

    def backward(thread):
      self._gradients[thread][:] = 0
      fused_kernels.train_rays(
        self.pictures,
        kernel,
        engine.occupancy,
        engine.network,
        self._gradient_networks[thread],
        self.table,
        resolutions,
        entries,
        engine.chunks[thread],
        seed,
        thread << 32,
        self._budget,
        np.float32(settings.transmittance_threshold),
        figures[thread],
      )

    def update(thread):
      for level in self._levels[thread]:
        for t, chunk in enumerate(engine.chunks):
          fused_grid.scatter_level(
            self.gradient,
            level,
            resolutions[level],
            entries,
            chunk.coordinates,
            int(figures[t, 1]),
            chunk.d_features,
            len(resolutions),
          )
        fused_grid.adam(
          self.table,
          self.moments[0],
          self.moments[1],
          self.gradient,
          level * entries * 2,
          (level + 1) * entries * 2,
          learning_rate,
          0.0,
          settings.adam_beta1,
          settings.adam_beta2,
          settings.adam_epsilon,
          self.steps_done + 1,
        )

    engine.run(backward)
    engine.run(update)
    total = self._gradients[0]
    for other in self._gradients[1:]:
      total += other
    # The rows of base_w1 that see the variance come behind those of the features.
    first = engine.settings.levels * engine.settings.features * engine.settings.width
    after = first + 3 * engine.settings.width
    for start, stop, factor in (
      (0, first, 1.0),
      (first, after, settings.variance_rate),
      (after, len(total), 1.0),
    ):
      fused_grid.adam(
        self.flat,
        self.moments[2],
        self.moments[3],
        total,
        start,
        stop,
        learning_rate * factor,
        settings.weight_decay,
        settings.adam_beta1,
        settings.adam_beta2,
        settings.adam_epsilon,
        self.steps_done + 1,
      )
    refresh(engine.settings, engine.network)
    self.steps_done += 1
    sums = figures.sum(0)
    self.rays_done += int(sums[0])
    self.samples_done += int(sums[2])
    if sums[2] < settings.refine_samples * sums[0] and self._coarseness > 1:
      self._coarseness //= 2
    elif sums[2] > _COARSEN_RATIO * settings.refine_samples * sums[0]:
      self._coarseness = min(self._coarseness * 2, _COARSEST)
    sweeping = self.steps_done <= settings.occupancy_sweep_steps
    due = self.steps_done % (settings.occupancy_interval << sweeping) == 0
    if due and self.steps_done >= settings.occupancy_start:
      self._update_occupancy()
    return {
      "rays": sums[0],
      "samples": sums[2],
      "kept_samples": sums[1],
      "psnr_db": float(-10 * np.log10(max(sums[3] / sums[0], 1e-12))),
      "charbonnier": sums[4] / sums[0],
      "distortion": sums[5] / sums[0],
    }

  def _update_occupancy(self) -> None:
    """Looks at all cells early on, then at a stretch of them in a scrambled order."""
    engine, settings = self.engine, self.settings
    rng = np.random.default_rng((self.seed, self.steps_done))
    inner, outer = engine.occupancy.inner_size**3, engine.occupancy.outer_size**3
    total = inner + outer
    sweeping = self.steps_done <= settings.occupancy_sweep_steps
    count = total if sweeping else min(settings.occupancy_samples, total)
    # A stride coprime to the number of cells visits every cell once before any twice.
    cells = (self._sweep + np.arange(count)) % total * _CELL_STRIDE % total
    self._sweep = (self._sweep + count) % total
    decay = _SWEEP_DECAY if sweeping else settings.occupancy_decay
    if self.steps_done < settings.occupancy_start + 2 * settings.occupancy_interval:
      decay = 0.0  # the first look replaces what was assumed
    engine.update_occupancy(cells[cells < inner], rng, inner=True, decay=decay)
    engine.update_occupancy(cells[cells >= inner] - inner, rng, inner=False, decay=decay)
    engine.refresh_distances(threshold=settings.occupancy_threshold)

  def field(self) -> Field:
    """Returns a copy of the field as it is now."""
    params: dict[str, Any] = unflatten(self.settings.field, self.flat)
    params["table"] = self.table.reshape(self.settings.field.shapes["table"]).copy()
    return Field(self.settings.field, params, self.pixel_angle)

  def state(self) -> dict[str, np.ndarray]:
    """Returns everything that a later run needs to continue, by name."""
    occupancy = self.engine.occupancy
    counters = [self.steps_done, self.rays_done, self.samples_done, self._sweep, self._coarseness]
    return {
      "table": self.table,
      "network": self.flat,
      **{f"moment_{i}": moment for i, moment in enumerate(self.moments)},
      "inner_density": occupancy.inner_density,
      "outer_density": occupancy.outer_density,
      "counters": np.array(counters, np.int64),
    }

  def restore(self, arrays: dict[str, np.ndarray]) -> None:
    """Continues from what `state` returned."""
    self.table[:] = arrays["table"]
    self.flat[:] = arrays["network"]
    for i, moment in enumerate(self.moments):
      moment[:] = arrays[f"moment_{i}"]
    self.engine.occupancy.inner_density[:] = arrays["inner_density"]
    self.engine.occupancy.outer_density[:] = arrays["outer_density"]
    numbers = [int(x) for x in arrays["counters"]]
    self.steps_done, self.rays_done, self.samples_done, self._sweep, self._coarseness = numbers
    refresh(self.engine.settings, self.engine.network)
    if self.steps_done >= self.settings.occupancy_start:
      self.engine.refresh_distances(threshold=self.settings.occupancy_threshold)


class FusedField:
  """Evaluates a trained field on CPU threads."""

  def __init__(self, field: Field, *, settings: TrainSettings | None = None):
    check_supported(field.settings)
    settings = settings or TrainSettings(field=field.settings)
    flat = flatten(field.settings, field.params)
    network = network_arrays(field.settings, flat)
    refresh(field.settings, network)
    threads = num_threads()
    self._engine = Engine(
      field.settings,
      kernel_settings(field.settings, field.training_pixel_angle, settings),
      np.ascontiguousarray(field.params["table"], np.float32).ravel(),
      network,
      full_occupancy(settings.inner_cells, settings.outer_cells, 0.0),
      [make_chunk(field.settings, samples=2048, stored=2048) for _ in range(threads)],
      ThreadPoolExecutor(threads),
    )
    self._settings = settings
    self._has_occupancy = False

  def densities(self, positions: np.ndarray, *, sigma: float) -> np.ndarray:
    """Densities [...] [1/unit] at positions [..., 3], averaged over a standard deviation [unit]."""
    positions = np.asarray(positions, np.float32)
    return self._engine.densities(positions.reshape(-1, 3), sigma=sigma).reshape(
      positions.shape[:-1]
    )

  def build_occupancy(self, *, looks: int = 4) -> None:
    """Looks into every occupancy cell `looks` times."""
    rng = np.random.default_rng(0)
    occupancy = self._engine.occupancy
    for _ in range(looks):
      for inner, size in ((True, occupancy.inner_size), (False, occupancy.outer_size)):
        self._engine.update_occupancy(np.arange(size**3), rng, inner=inner, decay=1.0)
    self._engine.refresh_distances(threshold=self._settings.occupancy_threshold)
    self._has_occupancy = True

  def render_rays(
    self, origins: np.ndarray, directions: np.ndarray, *, pixel_angle: float
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders rays.

    Args:
      origins: [N, 3] in the unit frame.
      directions: Unit vectors [N, 3].
      pixel_angle: Angle that a pixel of the wanted picture spans [rad].

    Returns:
      colours [N, 3] over black (not clipped), expected distances [N] and opacities [N].
    """
    if not self._has_occupancy:
      self.build_occupancy()
    engine = self._engine
    rays = np.concatenate([origins, directions], axis=-1).astype(np.float32).ravel()
    count = len(rays) // 6
    colors, depths = np.zeros(3 * count, np.float32), np.zeros(count, np.float32)
    opacities = np.zeros(count, np.float32)
    ratio = max(pixel_angle / float(engine.kernel.pixel_angle), 1e-3)
    if engine.kernel.paper_footprint:
      footprint = 1.0 + np.sqrt(max(ratio**2 - 1, 0.0) / 12)
    else:
      footprint = ratio**2
    bounds = np.linspace(0, count, 4 * len(engine.chunks) + 1).astype(np.int64)

    def work(thread):
      for part in range(thread, len(bounds) - 1, len(engine.chunks)):
        fused_kernels.render_rays(
          engine.kernel,
          engine.occupancy,
          engine.network,
          engine.table,
          engine.resolutions,
          engine.entries,
          engine.chunks[thread],
          rays,
          bounds[part],
          bounds[part + 1],
          np.float32(footprint),
          colors,
          depths,
          opacities,
        )

    engine.run(work)
    return colors.reshape(count, 3), depths, opacities

  def render(
    self, camera: Camera, unit_from_camera: np.ndarray, *, pixel_angle: float | None = None
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders a picture: colours uint8 [H, W, 3], z-depths [H, W] [unit], opacities [H, W].

    The field is told that the pixels span `pixel_angle` [rad]; the camera's own if None.
    """
    rays = camera.rays()
    norms = np.linalg.norm(rays, axis=-1)
    directions = (rays / norms[..., None]) @ unit_from_camera[:3, :3].T
    origins = np.broadcast_to(unit_from_camera[:3, 3], directions.shape)
    colors, distances, opacities = self.render_rays(
      origins.reshape(-1, 3),
      directions.reshape(-1, 3),
      pixel_angle=camera.pixel_angle if pixel_angle is None else pixel_angle,
    )
    shape = norms.shape
    picture = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8).reshape(*shape, 3)
    return picture, distances.reshape(shape) / norms, opacities.reshape(shape)


def density_grid(
  field: Field, resolution: int, lower: np.ndarray, upper: np.ndarray, *, sigma: float | None = None
) -> np.ndarray:
  """Samples the density on a regular grid, for marching cubes.

  Args:
    field: The field.
    resolution: Points along an axis, R.
    lower, upper: Corners of the box in the unit frame [3]; points lie on both.
    sigma: Standard deviation that densities are averaged over [unit]; the deviation of a training
      sample's interval if None.

  Returns:
    Densities float32 [R, R, R] in order x, y, z [1/unit].
  """
  evaluator = FusedField(field)
  sigma = field.settings.march_step / np.sqrt(12) if sigma is None else sigma
  axes = [np.linspace(lower[i], upper[i], resolution, dtype=np.float32) for i in range(3)]
  grid = np.empty((resolution,) * 3, np.float32)
  for i, x in enumerate(axes[0]):
    points = np.stack(np.meshgrid(x, axes[1], axes[2], indexing="ij"), axis=-1)[0]
    grid[i] = evaluator.densities(points, sigma=sigma)
  return grid
