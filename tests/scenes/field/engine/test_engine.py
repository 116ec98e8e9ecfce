"""The fused Warp kernels against JAX: gradients in chunks and in phases, rays, densities."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp

from nerf2real.scenes.field import losses as field_losses
from nerf2real.scenes.field import sampling
from nerf2real.scenes.field.encoding import sample_variance
from nerf2real.scenes.field.engine import (
  chunks,
  device,
  functions,
  layout,
  occupancy,
  parameters,
  phases,
)
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.engine.engine import Engine
from nerf2real.scenes.field.engine.trainer import FusedTrainer
from nerf2real.scenes.field.field import Field, FieldSettings, init_params, query
from nerf2real.scenes.field.settings import TrainSettings
from tests.scenes import box_views

SETTINGS = TrainSettings(
  field=FieldSettings(
    log2_table_size=10, growth=1.3, base_resolution=4, march_step=0.1, density_scale=3.0
  ),
  batch_samples=1 << 10,
  ray_samples=64,
  distortion_weight=0.3,
  near_gradient=0.8,
  depth_limit=1e9,
  blur_max=2.0,
  inner_cells=16,
  outer_cells=16,
  planar_weight=0.5,
  planar_bend=0.4,
  planar_contrast=0.8,
  planar_reach=0.6,
)
SEED, BUDGET = 5, 300


@functools.cache
def _initial_params():
  return init_params(jax.random.PRNGKey(0), SETTINGS.field)


def _rough_field(pixel_angle=0.05):
  """A field with parameters far from their initial values, so that every term matters."""
  rng = np.random.default_rng(0)
  params = {
    name: np.array(value + rng.normal(size=value.shape) * (0.3 if name == "table" else 0.1), "f4")
    for name, value in _initial_params().items()
  }
  return Field(SETTINGS.field, params, pixel_angle)


def _backward(*, phased=False, with_empty=False, rays=0, depth_limit=1e9, planar=0.0):
  """A trainer after one gradient, its worker's figures and the gradient by name."""
  settings = dataclasses.replace(SETTINGS, depth_limit=depth_limit, batch_samples=1 << 13)
  views = box_views.make_views(3, width=16, height=16, anchors=40)
  initial = _rough_field(views.camera.pixel_angle)
  trainer = FusedTrainer(views, settings, seed=1, initial=initial, phased=phased)
  assert trainer.pictures.empty.size > 100
  if not with_empty:
    trainer.pictures.empty = wp.zeros(0, dtype=wp.int32, device="cpu")
  trainer.engine.numbers.planar_fraction = planar
  if phased:
    trainer.add_gradient(SEED, rays=rays, threshold=0.0)
  else:
    trainer.work(0, SEED, budget=BUDGET, threshold=0.0)
    for level in range(trainer.engine.shape.levels):
      trainer.scatter(level)
  gradient = parameters.unflatten(SETTINGS.field, trainer.engine.workers[0].gradient.numpy())
  gradient["table"] = trainer.table.gradient.numpy().reshape(SETTINGS.field.shapes["table"])
  return trainer, trainer.figures()[0], gradient


@pytest.fixture(scope="module")
def backward():
  return _backward()


def _with_gradient(values, share):
  """The same values, with a share of their gradient."""
  return share * values + jax.lax.stop_gradient((1 - share) * values)


def _reference_losses(params, trainer, count):
  """The same rays and samples in JAX: sums of the Charbonnier and the distortion loss."""
  worker = trainer.engine.workers[0]
  rays = worker.rays.numpy().reshape(layout.RAY_ROWS, -1).T[:count]
  first = worker.first.numpy()[: count + 1]
  work = worker.work.numpy().reshape(-1, layout.STRIDE)
  most = np.diff(first).max()
  distance, length = np.ones((count, most), np.float32), np.zeros((count, most), np.float32)
  for ray in range(count):
    samples = slice(first[ray], first[ray + 1])
    distance[ray, : samples.stop - samples.start] = work[0, samples]
    length[ray, : samples.stop - samples.start] = work[1, samples]
  origins, directions, targets = rays[:, :3], rays[:, 3:6], rays[:, 6:9]
  positions = origins[:, None] + directions[:, None] * distance[..., None]
  along = jnp.broadcast_to(directions[:, None], positions.shape)
  interval = SETTINGS.field.march_step * jnp.maximum(jnp.abs(positions).max(-1), 1.0)
  variance = sample_variance(
    along,
    distance,
    interval,
    pixel_angle=trainer.engine.numbers.pixel_angle,
    footprint=rays[:, 9, None],
  )
  density, color = query(SETTINGS.field, params, positions, variance, along)
  share = np.minimum(1.0, np.square(distance / SETTINGS.near_gradient))
  assert 0 < share.min() < 0.5 and share.max() == 1
  density, color = _with_gradient(density, share), _with_gradient(color, share[..., None])
  weights = sampling.interval_weights(density, length)
  rest = 1 - weights.sum(1)
  total = (weights[..., None] * color).sum(1) + rest[:, None] * rays[:, 10:13]
  photometric = (
    field_losses.charbonnier(total, targets, padding=SETTINGS.charbonnier_padding) * count
  )
  extent = sampling.spacing(distance + length / 2) - sampling.spacing(distance - length / 2)
  order = jnp.argsort(distance + (length == 0) * 1e3, axis=-1)

  def sort(values):
    return jnp.take_along_axis(values, order, axis=-1)

  distortion = field_losses.distortion_of_intervals(
    sort(weights), sort(sampling.spacing(distance)), sort(extent)
  ).sum()
  goals = sampling.spacing(rays[:, 13])
  off = (weights * jnp.abs(sampling.spacing(distance) - goals[:, None])).sum(1) + rest * (1 - goals)
  anchored = SETTINGS.anchor_weight * jnp.where(rays[:, 13] > 0, off, 0).sum()
  loss = photometric + SETTINGS.distortion_weight * distortion + anchored
  loss += _bends(rays, (weights / distance).sum(1) * rays[:, 16])
  return loss, (photometric, distortion)


def _bends(rays, inverse):
  """Loss of the rays in threes: Geman and McClure's, of the bend of 1 / z along a line."""
  slot, number = rays[:, 14], rays[:, 15]
  total = 0.0
  for lead in range(len(rays) - 2):
    three = slice(lead, lead + 3)
    if list(slot[three]) != [1, 2, 3] or len(set(number[three])) > 1:
      continue
    near, middle, far = inverse[three]
    bend = (near - 2 * middle + far) / jax.lax.stop_gradient(middle)
    contrast = np.abs(rays[three, 6:9] - rays[lead + 1, 6:9]).max()
    weight = SETTINGS.planar_weight * np.exp(-contrast / SETTINGS.planar_contrast)
    total += weight * bend**2 / (bend**2 + SETTINGS.planar_bend**2)
  return total


@pytest.fixture(scope="module")
def planar():
  return _backward(planar=0.6)


@pytest.mark.parametrize("fixture", ["backward", "planar"])
def test_gradients_agree_with_autodiff(fixture, request):
  trainer, figures, gradient = request.getfixturevalue(fixture)
  params = _rough_field().params
  reference = jax.jit(
    jax.value_and_grad(
      functools.partial(_reference_losses, trainer=trainer, count=int(figures[0])), has_aux=True
    )
  )
  (_, (photometric, distortion)), expected = reference(params)
  np.testing.assert_allclose(figures[4], photometric, rtol=1e-5)
  np.testing.assert_allclose(figures[5], distortion, rtol=1e-5)
  for name, value in expected.items():
    error = np.linalg.norm(gradient[name] - value) / np.linalg.norm(value)
    assert error < 1e-4, (name, error)


@pytest.mark.parametrize("depth_limit", [0.5, 3.0])
def test_a_grid_that_is_too_dense_ends_no_ray(depth_limit):
  """The rays that were drawn, in phases without a limit, have the same losses and gradient."""
  limited = _backward(depth_limit=depth_limit)
  rays = int(limited[1][0])
  whole = _backward(phased=True, rays=rays)
  for found in (limited, _backward(phased=True, rays=rays, depth_limit=depth_limit)):
    _, kept, marched = found[1][:3].astype(int)
    assert marched > kept + rays / 2  # rays were marched again
    np.testing.assert_allclose(found[1][3:], whole[1][3:], rtol=1e-6)
    for name, value in whole[2].items():
      error = np.linalg.norm(found[2][name] - value) / np.linalg.norm(value)
      assert error < 1e-5, (name, error)


def test_some_rays_come_in_threes_along_a_line(planar, backward):
  trainer, figures, gradient = planar
  rays = trainer.engine.workers[0].rays.numpy().reshape(layout.RAY_ROWS, -1).T[: int(figures[0])]
  leads = [k for k in range(len(rays) - 2) if list(rays[k : k + 3, 14]) == [1, 2, 3]]
  assert 2 < len(leads) < len(rays) / 3
  camera = box_views.make_views(3, width=16, height=16).camera
  origins, rotations = (getattr(trainer.pictures, n).numpy() for n in ("origins", "rotations"))
  for lead in leads:
    three = rays[lead : lead + 3]
    picture = int(np.argmin(np.linalg.norm(origins - three[1, :3], axis=1)))
    np.testing.assert_allclose(three[:, :3], origins[[picture] * 3], atol=1e-6)
    pixels = camera.project(three[:, 3:6] @ rotations[picture])
    np.testing.assert_allclose(pixels[0] + pixels[2], 2 * pixels[1], atol=2e-3)
    assert np.sort(np.abs(pixels[2] - pixels[0])).round(2).tolist()[0] == 0  # a row or a column
    assert np.abs(pixels[2] - pixels[0]).max() > 3.9
  change = np.linalg.norm(gradient["table"] - backward[2]["table"])
  assert change > 0.01 * np.linalg.norm(gradient["table"])


@pytest.mark.parametrize("planar", [0.0, 0.6])
@pytest.mark.parametrize("with_empty", [False, True])
def test_phases_have_the_gradient_of_chunks(monkeypatch, with_empty, planar):
  """On one core, where a thread has more points known to be empty than a chunk holds."""
  monkeypatch.setattr(device, "num_threads", lambda: 1)
  _, figures, gradient = _backward(with_empty=with_empty, planar=planar)
  trainer, *_ = phases = _backward(
    phased=True, with_empty=with_empty, rays=int(figures[0]), planar=planar
  )
  assert trainer.engine.numbers.empty_samples > layout.CHUNK_SAMPLES
  np.testing.assert_allclose(phases[1][[0, 2, 3, 4, 5]], figures[[0, 2, 3, 4, 5]], rtol=1e-6)
  for name, value in gradient.items():
    error = np.linalg.norm(phases[2][name] - value) / np.linalg.norm(value)
    assert error < 1e-5, (name, error)


def _density(settings, params, positions, variances):
  return query(settings, params, positions, variances, jnp.zeros_like(positions))[0]


@jax.jit
def _empty_space_gradient(params, points, variances, factor):
  """Gradient of factor * mean of log(1 + density), compiled once for all tests."""

  def loss(params):
    return factor * jnp.log1p(_density(SETTINGS.field, params, points, variances)).mean()

  return jax.grad(loss)(params)


@pytest.mark.parametrize("phased", [False, True])
def test_empty_space_has_the_gradient_of_its_density(monkeypatch, backward, phased):
  """The difference that empty cells make, against autodiff of weight * log(1 + density)."""
  monkeypatch.setattr(device, "num_threads", lambda: 2)  # one chunk a thread, which it keeps
  without = backward[2]
  trainer, figures, gradient = _backward(phased=phased, with_empty=True, rays=int(backward[1][0]))
  count = trainer.engine.numbers.empty_samples
  worker = trainer.engine.workers[0]
  kept = worker.kept.numpy().reshape(-1, worker.kept_stride)
  start = 0 if phased else int(figures[1]) - count
  points = 4 * kept[:3, start : start + count].T - 2
  assert (np.abs(points) < box_views.HALF_SIZE).all()  # within the walls
  extents = worker.work.numpy().reshape(-1, trainer.engine.stride)[
    trainer.engine.shape.rows.INPUT + 2 * SETTINGS.field.levels, :count
  ]
  variances = np.exp2((extents - 1) * 20)[:, None].repeat(3, axis=1)
  assert 1e-6 < variances.min() < 2e-6 and 5e-3 < variances.max() < 1e-2

  factor = figures[0] * SETTINGS.empty_weight
  expected = _empty_space_gradient(_rough_field().params, points, variances, factor)
  for name in ("table", "base_w1", "base_b1", "base_w2", "base_b2"):
    change = gradient[name] - without[name]
    error = np.linalg.norm(change - expected[name]) / np.linalg.norm(expected[name])
    assert error < 1e-3, (name, error)


def test_rays_are_pixels_of_the_pictures(backward):
  trainer, figures, _ = backward
  rays = trainer.engine.workers[0].rays.numpy().reshape(layout.RAY_ROWS, -1).T[: int(figures[0])]
  sharp = rays[rays[:, 9] == 1.0]
  assert 3 < len(sharp) < len(rays)
  distance = box_views.wall_distance(sharp[:, :3], sharp[:, 3:6])
  expected = box_views.wall_color(sharp[:, :3] + distance[:, None] * sharp[:, 3:6])
  np.testing.assert_allclose(sharp[:, 6:9], expected, atol=3e-3)
  anchored = rays[:, 13] > 0
  assert 0 < anchored.sum() < len(rays)
  distance = box_views.wall_distance(rays[anchored, :3], rays[anchored, 3:6])
  np.testing.assert_allclose(rays[anchored, 13], distance, rtol=1e-4)


def test_densities_agree_with_the_field():
  field = _rough_field()
  rng = np.random.default_rng(3)
  positions = (rng.normal(size=(3000, 3)) * 1.5).astype(np.float32)
  found = Engine(field.settings, field.params, Device()).densities(positions, sigma=0.01)
  variances = np.full((3000, 3), 1e-4, np.float32)
  reference = jax.jit(functools.partial(_density, field.settings))
  expected = reference(field.params, positions, variances)
  np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_shapes_that_the_kernels_cannot_run_are_refused():
  with pytest.raises(ValueError, match=r"levels \* features = 10"):
    layout.Shape.of(FieldSettings(levels=5))


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda(tmp_path):
  shape = layout.Shape.of(dataclasses.replace(SETTINGS.field, levels=4))
  made = functions.build(shape, layout.STRIDE, layout.CHUNK_RAYS)
  kernels = chunks.build(made)._asdict() | phases.build(made)._asdict()
  for name, kernel in (kernels | {"distance": occupancy.distance_along}).items():
    wp.compile_aot_module(kernel.module, arch=90, module_dir=str(tmp_path / name), use_ptx=True)
    assert list((tmp_path / name).glob("*.ptx"))
