"""Training of a field with the fused Warp kernels, on CPU threads or a GPU."""

from typing import Any

import jax
import numpy as np
import warp as wp

from nerf2real.scenes.field.anchors import EMPTY_CELLS
from nerf2real.scenes.field.engine import layout, parameters, pictures
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.engine.engine import Engine
from nerf2real.scenes.field.engine.native.vectors import PADDING
from nerf2real.scenes.field.engine.occupancy import OccupancyGrids, distance_along
from nerf2real.scenes.field.engine.rays import NO_LIMIT
from nerf2real.scenes.field.field import Field, init_params
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import Views

_COARSEST = 8  # chosen: the first marches take steps of 16 cm in a room of 5 m
_COARSEN_RATIO = 5  # chosen: above 2, so that the march does not go back and forth
# Chosen, for a step in phases:
_ROOM = 1.25  # room for so many times the settings' samples; rays beyond it get none
_FEWEST_SAMPLES = 4  # samples a ray on which the room for rays is reckoned
_FIRST_SAMPLES = 64  # samples a ray expected of the first step
_STRETCH = 512  # samples that one thread sums a tile of the networks' gradient over


class FusedTrainer:
  """A training run: parameters, moments, occupancy; `step` improves them.

  On a CPU a thread does its share of a step in chunks that stay in its cache. Elsewhere the step
  runs in phases over all samples, a thread a sample; both call the same functions.
  """

  def __init__(
    self,
    views: Views,
    settings: TrainSettings,
    *,
    seed: int,
    initial: Field | None = None,
    device: str = "cpu",
    phased: bool | None = None,
  ):
    """Prepares a run.

    Args:
      views: Training pictures.
      settings: How to train.
      seed: Of the parameters and of the rays.
      initial: A field to start from.
      device: "cpu", "cuda" or another of Warp's names.
      phased: Whether to run in phases; if None, where the device is no CPU.
    """
    field = settings.field
    self.settings = settings
    self.seed = seed
    self.steps_done = 0
    self.rays_done = 0
    self.samples_done = 0
    self._phased = device != "cpu" if phased is None else phased
    self.device = Device(device, threads=1 if self._phased else None)
    self._budget = settings.batch_samples // self.device.threads
    # In phases the points known to be empty are the first samples.
    self._spare = -(-settings.empty_samples // PADDING) * PADDING
    stride, columns = layout.STRIDE, layout.CHUNK_RAYS
    # A step ends with the chunk that fills the budget, the rays of it that are marched again, and
    # the points known to be empty.
    kept = self._budget + layout.CHUNK_SAMPLES + PADDING + settings.empty_samples
    kept += layout.CHUNK_RAYS * settings.ray_samples
    if self._phased:
      samples = self._spare + int(_ROOM * self._budget)
      stride = kept = -(-samples // PADDING) * PADDING
      columns = self._budget // _FEWEST_SAMPLES
    self._columns = columns
    self._rays = min(columns, self._budget // _FIRST_SAMPLES)
    params = initial.params if initial else init_params(jax.random.PRNGKey(seed), field)
    self.engine = Engine(field, params, self.device, stride=stride, columns=columns, kept=kept)
    model, zeros = self.engine.model, self.device.zeros
    self.table = self._optimised(model.table, zeros(model.table.size))
    self.network = self._optimised(model.weights, self.engine.workers[0].gradient)
    # What a step's samples are counted in, and where those begin that the base network has next.
    self._used, self._since = zeros(1, np.int32), zeros(1, np.int32)
    # Dense levels leave the end of their part of the table unused.
    vertices = [min((cells + 1) ** 3, model.entries) for cells in field.resolutions]
    line = parameters.LINE
    self._used_values = [-(-2 * count // line) * line for count in vertices]
    self.grids = OccupancyGrids(settings, self.device, seed=seed)
    self.pictures: Any = pictures.upload(views, self.device, blur_max=settings.blur_max)
    self._pixel_angle = views.camera.pixel_angle
    self._apply_settings()
    self._last_known_step = settings.last_known_step(uneven=views.uneven)
    self._coarseness = 1 if initial else _COARSEST  # the march's step in units of the field's

  def _optimised(self, values: Any, gradient: Any) -> Any:
    """Adds Adam's moments to parameters."""
    result: Any = layout.Optimised()
    result.values, result.gradient = values, gradient
    result.first, result.second = (self.device.zeros(values.size) for _ in range(2))
    return result

  def _apply_settings(self) -> None:
    """Fills in the numbers that training needs."""
    train, numbers = self.settings, self.engine.numbers
    numbers.pixel_angle = self._pixel_angle
    numbers.step = train.field.march_step
    numbers.near = train.near
    numbers.near_scale = 1 / train.near_gradient**2 if train.near_gradient > 0 else 1e9
    numbers.depth_limit = train.depth_limit
    numbers.ray_samples = train.ray_samples
    numbers.charbonnier = train.charbonnier_padding
    numbers.distortion = train.distortion_weight
    numbers.blur_max = train.blur_max
    numbers.blur_sharp = train.blur_sharp_fraction
    numbers.blur_power = train.blur_power
    numbers.random_background = int(train.random_background)
    numbers.planar_weight = train.planar_weight
    numbers.planar_bend = train.planar_bend
    numbers.planar_contrast = train.planar_contrast
    numbers.planar_reach = max(round(train.planar_reach / self._pixel_angle), 3)
    numbers.anchor_fraction = train.anchor_fraction
    numbers.anchor_weight = train.anchor_weight
    numbers.empty_samples = train.empty_samples // self.device.threads
    numbers.empty_weight = train.empty_weight
    numbers.empty_size = EMPTY_CELLS

  def prepare(self) -> None:
    """Compiles the kernels without changing anything."""
    chunks = self.engine.chunks
    steps = self.engine.phases if self._phased else (chunks.train, chunks.scatter)
    self.device.load(chunks.adam, chunks.densities, distance_along, *steps)

  def step(self, learning_rate: float) -> dict[str, float]:
    """Makes one step; returns rays, samples, psnr_db, charbonnier and distortion of its batch."""
    self.prepare()
    settings, numbers, shape = self.settings, self.engine.numbers, self.engine.shape
    step = self.steps_done
    numbers.step = settings.field.march_step * self._coarseness
    numbers.depth_limit = settings.depth_limit if step >= settings.occupancy_start else NO_LIMIT
    known = step < self._last_known_step
    numbers.anchor_fraction = settings.anchor_fraction if known else 0.0
    numbers.empty_samples = settings.empty_samples // self.device.threads if known else 0
    numbers.planar_fraction = settings.planar_fraction if step >= settings.planar_start else 0.0
    numbers.distortion = settings.distortion_weight * settings.distortion_ramp(step)
    seed = (self.seed * 1_000_003 + step) & (2**63 - 1)
    threshold = settings.transmittance_threshold
    if self._phased:
      whole = max(self._rays - self._rays % 3, 1)  # threes; what is behind is of the step before
      self.add_gradient(seed, rays=whole, threshold=threshold)
      self._adam(self.table, 0, self.table.values.size, learning_rate)
    else:
      self.device.run(
        lambda thread: self.work(thread, seed, budget=self._budget, threshold=threshold)
      )
      self.device.run(lambda thread: self._update_levels(thread, learning_rate))
      total, *others = (worker.gradient.numpy() for worker in self.engine.workers)
      for other in others:
        total += other
    # The rows of base_w1 that see the variance come behind those of the features.
    first = 2 * shape.levels * shape.width
    after = first + 3 * shape.width
    for start, stop, factor in (
      (0, first, 1.0),
      (first, after, settings.variance_rate),
      (after, self.network.values.size, 1.0),
    ):
      rate = learning_rate * factor
      self._adam(self.network, start, stop, rate, decay=settings.weight_decay)
    return self._finish_step(self.figures().sum(0))

  def figures(self) -> np.ndarray:
    """What the workers counted [threads, 6], see `layout.Worker`."""
    return np.stack([worker.figures.numpy() for worker in self.engine.workers])

  def work(self, thread: int, seed: int, *, budget: int, threshold: float) -> None:
    """Fills a thread's gradient, kept samples and figures from random rays."""
    engine = self.engine
    fixed = [self.pictures, engine.numbers, self.grids.data, engine.model, engine.worker_array]
    self.device.launch(engine.chunks.train, [*fixed, seed, thread, budget, threshold])

  def scatter(self, level: int) -> None:
    """Adds a level's part of the table's gradient, of all threads' kept samples.

    One thread owns a level, so that no two threads write to the same entry and the sums have one
    order: a run can be repeated bit by bit.
    """
    engine = self.engine
    inputs = [self.table.gradient, engine.worker_array, engine.model, level]
    self.device.launch(engine.chunks.scatter, inputs)

  def _update_levels(self, thread: int, rate: float) -> None:
    """Gradient and optimiser of the table's levels that a thread owns."""
    for level in range(thread, self.engine.shape.levels, self.device.threads):
      self.scatter(level)
      start = 2 * level * self.engine.model.entries
      self._adam(self.table, start, start + self._used_values[level], rate)

  def add_gradient(self, seed: int, *, rays: int, threshold: float) -> None:
    """Fills the gradients and the figures from random rays, in phases."""
    engine, device = self.engine, self.device
    phases, numbers, model = engine.phases, engine.numbers, engine.model
    workers = engine.worker_array
    # A thread does a vector of samples on a CPU, one elsewhere.
    block = PADDING if device.is_cpu else 1
    used, since, spare = self._used, self._since, self._spare
    known = numbers.empty_samples > 0 and self.pictures.empty.size > 0
    first = 0 if known else spare
    room = engine.stride - PADDING
    blocks = (room - first) // block
    weight = numbers.empty_weight * rays / max(numbers.empty_samples, 1)
    parts = 1 if device.is_cpu else engine.shape.tiles
    stretches = -(-(engine.stride - first) // _STRETCH)
    engine.workers[0].gradient.zero_()
    engine.workers[0].figures.zero_()
    used.fill_(spare)
    since.fill_(first)
    begin, grids = [self.pictures, numbers], self.grids.data
    forward = [*begin, model, workers, seed, used, since, spare, block, weight]
    device.launch(phases.draw, [*begin, grids, workers, seed, used], dim=rays)
    device.launch(phases.forward, forward, dim=blocks)
    if numbers.depth_limit < NO_LIMIT:
      wp.copy(since, used)
      inputs = [numbers, grids, workers, seed, threshold, used]
      device.launch(phases.march_again, inputs, dim=rays)
      device.launch(phases.forward, forward, dim=blocks)
    device.launch(phases.see, [workers, threshold], dim=rays)
    inputs = [numbers, model, workers, used, spare, block]
    device.launch(phases.color, inputs, dim=(room - spare) // block)
    device.launch(phases.compare, [numbers, workers], dim=rays)
    device.launch(phases.backward, [model, workers, used, first, spare, block], dim=blocks)
    inputs = [workers, used, first, _STRETCH, parts]
    device.launch(phases.sum_products, inputs, dim=(parts, stretches))
    inputs = [self.table.gradient, workers, model, used, first, block]
    device.launch(phases.scatter, inputs, dim=(engine.shape.levels, blocks))

  def _adam(
    self, parameters: Any, start: int, stop: int, rate: float, *, decay: float = 0.0
  ) -> None:
    """Updates parameters [start, stop) where the gradient is not zero; clears the gradient."""
    settings, step = self.settings, self.steps_done + 1
    how: Any = layout.AdamW()
    how.rate, how.keep = rate, 1 - rate * decay
    how.beta1, how.beta2 = settings.adam_beta1, settings.adam_beta2
    how.epsilon = settings.adam_epsilon
    how.correction1 = 1 / (1 - settings.adam_beta1**step)
    how.correction2 = 1 / (1 - settings.adam_beta2**step)
    size = stop - start if self.device.is_cpu else 1
    inputs = [parameters, how, start, stop, size]
    self.device.launch(self.engine.chunks.adam, inputs, dim=-(-(stop - start) // size))

  def _finish_step(self, sums: np.ndarray) -> dict[str, float]:
    """Counts, adapts the march's step and looks at the occupancy where that is due."""
    settings = self.settings
    rays, kept, marched = sums[:3]
    self.steps_done += 1
    self.rays_done += int(rays)
    self.samples_done += int(marched)
    self._rays = max(
      1, min(self._columns, int(self._budget / max(marched / rays, _FEWEST_SAMPLES)))
    )
    if marched < settings.refine_samples * rays and self._coarseness > 1:
      self._coarseness //= 2
    elif marched > _COARSEN_RATIO * settings.refine_samples * rays:
      self._coarseness = min(self._coarseness * 2, _COARSEST)
    self.grids.update(self.engine, self.steps_done)
    # The kernels' minima and maxima drop NaN, so that losses stay finite; the weights keep it.
    broken = 0.0 if np.isfinite(self.network.values.numpy()).all() else float("nan")
    return {
      "rays": rays,
      "samples": marched,
      "kept_samples": kept,
      "psnr_db": float(-10 * np.log10(max(sums[3] / rays, 1e-12))),
      "charbonnier": sums[4] / rays + broken,
      "distortion": sums[5] / rays,
    }

  def field(self) -> Field:
    """Returns a copy of the field as it is now."""
    settings = self.settings.field
    return Field(settings, parameters.download(settings, self.engine.model), self._pixel_angle)

  def _counters(self) -> list[int]:
    return [self.steps_done, self.rays_done, self.samples_done, self._coarseness, self._rays]

  def state(self) -> dict[str, np.ndarray]:
    """Returns everything that a later run needs to continue, by name."""
    return {
      **{name: array.numpy() for name, array in self._arrays().items()},
      **self.grids.state(),
      "counters": np.array(self._counters(), np.int64),
    }

  def restore(self, arrays: dict[str, np.ndarray]) -> None:
    """Continues from what `state` returned."""
    for name, array in self._arrays().items():
      array.assign(arrays[name])
    self.steps_done, self.rays_done, self.samples_done, self._coarseness, self._rays = (
      int(value) for value in arrays["counters"]
    )
    self.grids.restore(arrays, step=self.steps_done)

  def _arrays(self) -> dict[str, Any]:
    """Parameters and moments on the device, by their name in a checkpoint."""
    return {
      f"{name}_{part}": getattr(optimised, part)
      for name, optimised in (("table", self.table), ("network", self.network))
      for part in ("values", "first", "second")
    }
