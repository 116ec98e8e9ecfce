"""Training in JAX as the paper does it: proposal sampling, all losses, AdamW. Runs on a GPU or CPU.

Shapes: R rays, M proposal intervals, N field intervals, K blur levels, P pictures.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nerf2real.scenes.field import encoding, sampling
from nerf2real.scenes.field import losses as field_losses
from nerf2real.scenes.field.contraction import grid_coordinates
from nerf2real.scenes.field.field import Field, init_params, layer_norm, query, squareplus
from nerf2real.scenes.field.settings import TrainSettings
from nerf2real.scenes.field.views import BlurPyramid, Views

FAR = 16.0  # rays end here [unit]; chosen: 15/16 of the squashed space is used up
_PROPOSAL_BASE = 16  # cells along an axis of the proposal grid's coarsest level

Params = dict[str, jax.Array]


class Pictures(NamedTuple):
  """Training pictures on the device."""

  levels: tuple[jax.Array, ...]  # uint8 [P, h, w, 3] each
  blurs: jax.Array  # [K]
  factors: jax.Array  # [K]
  directions: jax.Array  # [H, W, 3], z = 1
  poses: jax.Array  # [P, 3, 4]
  anchors: jax.Array  # [A, 4], see views.Views


class Rays(NamedTuple):
  """A batch of training rays."""

  origins: jax.Array  # [R, 3]
  directions: jax.Array  # unit vectors [R, 3]
  targets: jax.Array  # [R, 3]
  footprints: jax.Array  # [R]
  anchors: jax.Array  # [R]: known distances, 0 where unknown


class State(NamedTuple):
  """What a step changes."""

  params: Params
  optimizer: optax.OptState
  step: jax.Array


def proposal_resolutions(settings: TrainSettings) -> tuple[int, ...]:
  """Cells along an axis of the proposal grid's levels."""
  steps = max(settings.proposal_levels - 1, 1)
  growth = (settings.proposal_finest_resolution / _PROPOSAL_BASE) ** (1 / steps)
  return encoding.grid_resolutions(_PROPOSAL_BASE, growth, settings.proposal_levels)


def init_proposal(key: jax.Array, settings: TrainSettings) -> Params:
  """Draws the proposal network's parameters: a small hash grid and `proposal_depth` layers."""
  table_key, *keys = jax.random.split(key, settings.proposal_depth + 1)
  shape = (settings.proposal_levels, 2**settings.proposal_log2_table_size, 2)
  params = {"proposal_table": jax.random.uniform(table_key, shape, minval=-1e-4, maxval=1e-4)}
  inputs = settings.proposal_levels * 2 + 3
  for layer, draw in enumerate(keys):
    outputs = settings.proposal_width if layer < settings.proposal_depth - 1 else 1
    limit = float(np.sqrt(6.0 / (inputs + outputs)))
    params[f"proposal_w{layer}"] = jax.random.uniform(
      draw, (inputs, outputs), minval=-limit, maxval=limit
    )
    params[f"proposal_b{layer}"] = jnp.zeros(outputs)
    inputs = outputs
  return params


def proposal_density(
  settings: TrainSettings,
  params: Mapping[str, jax.Array],
  positions: jax.Array,
  variances: jax.Array,
) -> jax.Array:
  """The proposal network's density [...] at positions [..., 3] with variances [..., 3]."""
  features = encoding.hash_encode(
    params["proposal_table"],
    grid_coordinates(positions),
    resolutions=proposal_resolutions(settings),
  )
  x = jnp.concatenate([features, encoding.variance_features(variances)], axis=-1)
  for layer in range(settings.proposal_depth):
    x = x @ params[f"proposal_w{layer}"] + params[f"proposal_b{layer}"]
    if layer < settings.proposal_depth - 1:
      x = jax.nn.swish(x)
      x = layer_norm(x) if layer == settings.proposal_depth - 2 else x
  return settings.field.density_scale * squareplus(
    settings.field.density_gain * x[..., 0] + settings.field.density_bias
  )


class Rendered(NamedTuple):
  """Rays rendered with proposal sampling."""

  color: jax.Array  # [R, 3], without background
  opacity: jax.Array  # [R]
  edges: jax.Array  # normalised [R, N + 1]
  weights: jax.Array  # [R, N]
  proposal_edges: jax.Array  # normalised [R, M + 1]
  proposal_weights: jax.Array  # [R, M]


def render_rays(
  settings: TrainSettings,
  params: Mapping[str, jax.Array],
  key: jax.Array,
  origins: jax.Array,
  directions: jax.Array,
  *,
  pixel_angle: float,
  footprints: jax.Array | float = 1.0,
) -> Rendered:
  """Renders rays [R]: proposal samples, resampling after dilation, samples of the field.

  Source: Barron et al. 2022, Mip-NeRF 360, section 3; NeRF2Real, NeRF table.
  """
  coarse_key, fine_key = jax.random.split(key)

  def place(edges):
    t = sampling.inverse_spacing(edges)
    middles, lengths = 0.5 * (t[..., 1:] + t[..., :-1]), jnp.diff(t, axis=-1)
    positions = origins[:, None] + middles[..., None] * directions[:, None]
    along = jnp.broadcast_to(directions[:, None], positions.shape)
    variances = encoding.sample_variance(
      along,
      middles,
      lengths,
      pixel_angle=pixel_angle,
      footprint=jnp.broadcast_to(jnp.asarray(footprints), origins.shape[:1])[:, None],
    )
    return positions, along, variances, lengths

  coarse = sampling.stratified(
    coarse_key, origins.shape[0], settings.proposal_samples, near=settings.near, far=FAR
  )
  positions, _, variances, lengths = place(coarse)
  density = proposal_density(settings, params, positions, variances)
  proposal_weights = sampling.interval_weights(density, lengths)
  wide_edges, wide_weights = sampling.dilate(
    coarse, proposal_weights, dilation=settings.sample_dilation
  )
  edges = sampling.resample(fine_key, wide_edges, wide_weights, settings.final_samples)
  positions, along, variances, lengths = place(edges)
  density, color = query(settings.field, params, positions, variances, along)
  weights = sampling.interval_weights(density, lengths)
  return Rendered(
    jnp.sum(weights[..., None] * color, axis=-2),
    jnp.sum(weights, axis=-1),
    edges,
    weights,
    coarse,
    proposal_weights,
  )


def make_pictures(views: Views, *, blur_max: float) -> Pictures:
  """Puts pictures, blurred copies and poses on the device."""
  pyramid = BlurPyramid.build(views, blur_max=blur_max)
  return Pictures(
    tuple(jnp.asarray(level) for level in pyramid.levels),
    jnp.asarray(pyramid.blurs, jnp.float32),
    jnp.asarray(pyramid.factors, jnp.float32),
    jnp.asarray(views.camera.rays(), jnp.float32),
    jnp.asarray(views.world_from_camera[:, :3], jnp.float32),
    jnp.asarray(views.anchors, jnp.float32),
  )


def _look_up(level: jax.Array, factor: jax.Array, image, x, y) -> jax.Array:
  """Bilinear colours [R, 3] at the centres of full-size pixels (x, y)."""
  height, width = level.shape[1:3]
  fx = jnp.maximum((x + 0.5) / factor - 0.5, 0.0)
  fy = jnp.maximum((y + 0.5) / factor - 0.5, 0.0)
  x0 = jnp.minimum(fx.astype(jnp.int32), width - 1)
  y0 = jnp.minimum(fy.astype(jnp.int32), height - 1)
  x1, y1 = jnp.minimum(x0 + 1, width - 1), jnp.minimum(y0 + 1, height - 1)
  wx, wy = (fx - x0)[:, None], (fy - y0)[:, None]
  upper = level[image, y0, x0] * (1 - wx) + level[image, y0, x1] * wx
  lower = level[image, y1, x0] * (1 - wx) + level[image, y1, x1] * wx
  return (upper * (1 - wy) + lower * wy) / 255.0


def draw_rays(
  pictures: Pictures, settings: TrainSettings, key: jax.Array, *, known: jax.Array | bool = True
) -> Rays:
  """Draws pixels and blurs, and reads the blurred colours by mixing neighbouring levels."""
  keys = jax.random.split(key, 7)
  count, (height, width) = settings.batch_rays, pictures.directions.shape[:2]
  image = jax.random.randint(keys[0], (count,), 0, pictures.poses.shape[0])
  x = jax.random.randint(keys[1], (count,), 0, width)
  y = jax.random.randint(keys[2], (count,), 0, height)
  blurred = jax.random.uniform(keys[3], (count,)) >= settings.blur_sharp_fraction
  blur = settings.blur_max * jax.random.uniform(keys[4], (count,)) ** settings.blur_power
  blur = jnp.where(blurred, blur, 0.0)
  distances = jnp.zeros(count)
  if len(pictures.anchors):
    chosen = pictures.anchors[jax.random.randint(keys[5], (count,), 0, len(pictures.anchors))]
    fraction = jnp.where(known, settings.anchor_fraction, 0.0)
    use = jax.random.uniform(keys[6], (count,)) < fraction
    image = jnp.where(use, chosen[:, 0].astype(jnp.int32), image)
    x = jnp.where(use, chosen[:, 1].astype(jnp.int32), x)
    y = jnp.where(use, chosen[:, 2].astype(jnp.int32), y)
    blur, distances = jnp.where(use, 0.0, blur), jnp.where(use, chosen[:, 3], 0.0)
  targets = _look_up(pictures.levels[0], pictures.factors[0], image, x, y)
  for k in range(1, len(pictures.levels)):
    low, high = pictures.blurs[k - 1], pictures.blurs[k]
    mix = jnp.clip((blur**2 - low**2) / (high**2 - low**2), 0.0, 1.0)[:, None]
    value = _look_up(pictures.levels[k], pictures.factors[k], image, x, y)
    targets = targets + mix * (value - targets)
  rotation = pictures.poses[image, :, :3]
  directions = jnp.einsum("rij,rj->ri", rotation, pictures.directions[y, x])
  directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
  footprints = encoding.blur_footprint(blur)
  return Rays(pictures.poses[image, :, 3], directions, targets, footprints, distances)


def loss_of_rays(
  params: Params, settings: TrainSettings, key: jax.Array, rays: Rays, *, pixel_angle: float
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Returns the training loss and charbonnier, distortion, interlevel, anchor and psnr_db."""
  render_key, background_key = jax.random.split(key)
  out = render_rays(
    settings,
    params,
    render_key,
    rays.origins,
    rays.directions,
    pixel_angle=pixel_angle,
    footprints=rays.footprints,
  )
  background = jnp.zeros_like(rays.targets)
  if settings.random_background:
    background = jax.random.uniform(background_key, rays.targets.shape)
  color = out.color + (1.0 - out.opacity)[:, None] * background
  photometric = field_losses.charbonnier(color, rays.targets, padding=settings.charbonnier_padding)
  distortion = field_losses.distortion(out.weights, out.edges)
  interlevel = field_losses.interlevel(
    out.edges, out.weights, out.proposal_edges, out.proposal_weights
  )
  anchor = field_losses.anchor(
    out.weights, out.edges, sampling.spacing(rays.anchors), rays.anchors > 0
  )
  loss = (
    photometric
    + settings.distortion_weight * distortion
    + settings.interlevel_weight * interlevel
    + settings.anchor_weight * anchor
  )
  error = jnp.mean(jnp.square(color - rays.targets))
  return loss, {
    "charbonnier": photometric,
    "distortion": distortion,
    "interlevel": interlevel,
    "anchor": anchor,
    "psnr_db": -10.0 * jnp.log10(jnp.maximum(error, 1e-12)),
  }


class ReferenceTrainer:
  """A training run in JAX; `step` improves the parameters."""

  def __init__(
    self, views: Views, settings: TrainSettings, *, seed: int, initial: Field | None = None
  ):
    self.settings = settings
    self.pixel_angle = views.camera.pixel_angle
    self.samples_done = 0
    self.rays_done = 0
    self._seed = seed
    self._last_known_step = settings.last_known_step(uneven=views.uneven)
    self._pictures = make_pictures(views, blur_max=settings.blur_max)
    field_key, proposal_key = jax.random.split(jax.random.PRNGKey(seed))
    params: Params = {
      **init_params(field_key, settings.field),
      **init_proposal(proposal_key, settings),
    }
    if initial is not None:
      for name, value in initial.params.items():
        if name in params and params[name].shape == np.shape(value):
          params[name] = jnp.asarray(value, jnp.float32)
    self._optimizer = optax.chain(
      optax.scale_by_adam(
        b1=settings.adam_beta1, b2=settings.adam_beta2, eps=settings.adam_epsilon
      ),
      optax.add_decayed_weights(settings.weight_decay),
    )
    self._state = State(params, self._optimizer.init(params), jnp.zeros((), jnp.int32))
    self._step: Any = jax.jit(self._make_step())

  @property
  def steps_done(self) -> int:
    """Steps made so far."""
    return int(self._state.step)

  def _make_step(self):
    settings, optimizer, pixel_angle = self.settings, self._optimizer, self.pixel_angle
    last_known = self._last_known_step

    def step(state: State, pictures: Pictures, learning_rate: jax.Array):
      key = jax.random.fold_in(jax.random.PRNGKey(self._seed), state.step)
      draw_key, loss_key = jax.random.split(key)
      rays = draw_rays(pictures, settings, draw_key, known=state.step < last_known)
      gradient, metrics = jax.grad(loss_of_rays, has_aux=True)(
        state.params, settings, loss_key, rays, pixel_angle=pixel_angle
      )
      updates, optimizer_state = optimizer.update(gradient, state.optimizer, state.params)
      updates = jax.tree.map(lambda u: -learning_rate * u, updates)
      params = optax.apply_updates(state.params, updates)
      return State(params, optimizer_state, state.step + 1), metrics

    return step

  def prepare(self) -> None:
    """Compiles the step without changing anything."""
    self._step = self._step.lower(self._state, self._pictures, jnp.float32(0)).compile()

  def step(self, learning_rate: float) -> dict[str, float]:
    """Makes one step; returns the losses and the batch's PSNR."""
    self._state, metrics = self._step(self._state, self._pictures, jnp.float32(learning_rate))
    rays = self.settings.batch_rays
    samples = rays * (self.settings.proposal_samples + self.settings.final_samples)
    self.rays_done += rays
    self.samples_done += samples
    numbers = {name: float(value) for name, value in metrics.items()}
    return {**numbers, "rays": float(rays), "samples": float(samples)}

  def field(self) -> Field:
    """Returns a copy of the field as it is now, the proposal network included."""
    params: dict[str, Any] = {k: np.asarray(v) for k, v in self._state.params.items()}
    return Field(self.settings.field, params, self.pixel_angle)

  def state(self) -> dict[str, np.ndarray]:
    """Returns everything that a later run needs to continue, by name."""
    leaves = jax.tree.leaves(self._state)
    arrays = {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    arrays["counters"] = np.array([self.rays_done, self.samples_done], np.int64)
    return arrays

  def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
    """Continues from what `state` returned."""
    current, structure = jax.tree.flatten(self._state)
    leaves = [jnp.asarray(arrays[f"leaf_{i:03d}"]) for i in range(len(current))]
    self._state = jax.tree.unflatten(structure, leaves)
    self.rays_done, self.samples_done = (int(x) for x in arrays["counters"])
