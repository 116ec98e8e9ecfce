"""The fused kernels against JAX: gradients, forward values, and against scipy for distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

from nerf2real.scenes.field import losses as field_losses
from nerf2real.scenes.field import sampling
from nerf2real.scenes.field.encoding import sample_variance
from nerf2real.scenes.field.field import Field, FieldSettings, init_params, query, query_density
from nerf2real.scenes.field.fused import engine as fused_engine
from nerf2real.scenes.field.fused import grid as fused_grid
from nerf2real.scenes.field.fused import kernels as fused_kernels
from nerf2real.scenes.field.fused import march as fused_march
from nerf2real.scenes.field.fused import trainer as fused
from nerf2real.scenes.field.settings import TrainSettings
from tests.scenes import box_views

SETTINGS = TrainSettings(
  field=FieldSettings(
    log2_table_size=10, growth=1.3, base_resolution=4, march_step=0.1, density_scale=3.0
  ),
  batch_samples=1 << 10,
  ray_samples=64,
  distortion_weight=0.3,
  depth_limit=1e9,
  blur_max=2.0,
  inner_cells=16,
  outer_cells=16,
)


def _rough_field(pixel_angle=0.05):
  """A field with parameters far from their initial values, so that every term matters."""
  rng = np.random.default_rng(0)
  params = {
    name: np.array(value + rng.normal(size=value.shape) * (0.3 if name == "table" else 0.1), "f4")
    for name, value in init_params(jax.random.PRNGKey(0), SETTINGS.field).items()
  }
  return Field(SETTINGS.field, params, pixel_angle)


@pytest.fixture(scope="module")
def backward():
  """A trainer, one chunk's rays and samples, its figures and its gradient."""
  return _backward(with_empty=False)


def _backward(*, with_empty):
  views = box_views.make_views(3, width=16, height=16, anchors=40)
  trainer = fused.FusedTrainer(
    views, SETTINGS, seed=1, initial=_rough_field(views.camera.pixel_angle)
  )
  engine, figures = trainer.engine, np.zeros(6)
  pictures = trainer.pictures
  assert len(pictures.empty) > 100
  if not with_empty:
    pictures = pictures._replace(empty=np.zeros(0, np.int64))
  fused_kernels.train_rays(
    pictures,
    engine.kernel,
    engine.occupancy,
    engine.network,
    trainer._gradient_networks[0],
    trainer.table,
    engine.resolutions,
    engine.entries,
    engine.chunks[0],
    np.uint64(5),
    0,
    300,
    np.float32(0),
    figures,
  )
  chunk = engine.chunks[0]
  for level, resolution in enumerate(engine.resolutions):
    fused_grid.scatter_level(
      trainer.gradient,
      level,
      resolution,
      engine.entries,
      chunk.coordinates,
      int(figures[1]),
      chunk.d_features,
      len(engine.resolutions),
    )
  gradient = fused_engine.unflatten(SETTINGS.field, trainer._gradients[0])
  gradient["table"] = trainer.gradient.reshape(SETTINGS.field.shapes["table"])
  return trainer, chunk, figures, gradient


def _told_length(positions):
  """Interval length that the variance tells of, however coarse the march is."""
  return SETTINGS.field.march_step * jnp.maximum(jnp.abs(positions).max(-1), 1.0)


def _reference_losses(params, trainer, chunk, count):
  """The same rays and samples in JAX: sums of the Charbonnier and the distortion loss."""
  rays, first = chunk.rays.reshape(-1, 14)[:count], chunk.first[: count + 1]
  most = np.diff(first).max()
  distance, length = np.ones((count, most), np.float32), np.zeros((count, most), np.float32)
  for ray in range(count):
    samples = slice(first[ray], first[ray + 1])
    distance[ray, : samples.stop - samples.start] = chunk.distance[samples]
    length[ray, : samples.stop - samples.start] = chunk.length[samples]
  origins, directions, targets = rays[:, :3], rays[:, 3:6], rays[:, 6:9]
  positions = origins[:, None] + directions[:, None] * distance[..., None]
  along = jnp.broadcast_to(directions[:, None], positions.shape)
  variance = sample_variance(
    along,
    distance,
    _told_length(positions),
    pixel_angle=trainer.pixel_angle,
    footprint=rays[:, 9, None],
  )
  density, color = query(SETTINGS.field, params, positions, variance, along)
  weights = sampling.interval_weights(density, length)
  rest = 1 - weights.sum(1)
  total = (weights[..., None] * color).sum(1) + rest[:, None] * rays[:, 10:13]
  photometric = field_losses.charbonnier(total, targets, padding=1e-3) * count
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
  return loss, (photometric, distortion)


def test_anchored_rays_know_their_distance(backward):
  _, chunk, figures, _ = backward
  rays = chunk.rays.reshape(-1, 14)[: int(figures[0])]
  anchored = rays[:, 13] > 0
  assert 0 < anchored.sum() < len(rays)
  np.testing.assert_array_equal(rays[anchored, 9], 1.0)
  distance = box_views.wall_distance(rays[anchored, :3], rays[anchored, 3:6])
  np.testing.assert_allclose(rays[anchored, 13], distance, rtol=1e-4)


def test_empty_space_has_the_gradient_of_its_density(backward):
  """The difference that empty cells make, against autodiff of weight * log(1 + density)."""
  *_, without = backward
  trainer, chunk, figures, gradient = _backward(with_empty=True)
  count = trainer.engine.kernel.empty_samples
  total = int(figures[1])
  points = 4 * chunk.coordinates[3 * (total - count) : 3 * total].reshape(-1, 3) - 2
  assert (np.abs(points) < box_views.HALF_SIZE).all()  # within the walls
  sigmas = [10.0 ** (2 * fused_march.uniform(np.uint64(5), n, 20) - 3) for n in range(count)]
  variances = np.square(np.array(sigmas, np.float32))[:, None].repeat(3, axis=1)

  def loss(params):
    density = query_density(SETTINGS.field, params, points, variances)
    return figures[0] * SETTINGS.empty_weight * jnp.log1p(density).mean()

  expected = jax.grad(loss)(_rough_field().params)
  for name in ("table", "base_w1", "base_b1", "base_w2", "base_b2"):
    change = gradient[name] - without[name]
    error = np.linalg.norm(change - expected[name]) / np.linalg.norm(expected[name])
    assert error < 1e-3, (name, error)


def test_gradients_agree_with_autodiff(backward):
  trainer, chunk, figures, gradient = backward
  params = _rough_field().params
  (_, (photometric, distortion)), expected = jax.value_and_grad(_reference_losses, has_aux=True)(
    params, trainer, chunk, int(figures[0])
  )
  np.testing.assert_allclose(figures[4], photometric, rtol=1e-5)
  np.testing.assert_allclose(figures[5], distortion, rtol=1e-5)
  for name, value in expected.items():
    error = np.linalg.norm(gradient[name] - value) / np.linalg.norm(value)
    assert error < 1e-4, (name, error)


def test_rays_are_pixels_of_the_pictures(backward):
  trainer, chunk, figures, _ = backward
  rays = chunk.rays.reshape(-1, 14)[: int(figures[0])]
  sharp = rays[rays[:, 9] == 1.0]
  assert 3 < len(sharp) < len(rays)
  distance = box_views.wall_distance(sharp[:, :3], sharp[:, 3:6])
  expected = box_views.wall_color(sharp[:, :3] + distance[:, None] * sharp[:, 3:6])
  np.testing.assert_allclose(sharp[:, 6:9], expected, atol=3e-3)
  origins = trainer.pictures.origins.reshape(-1, 3)
  assert all(np.isclose(origins, o).all(-1).any() for o in rays[:, :3])


def test_densities_agree_with_the_field():
  field = _rough_field()
  rng = np.random.default_rng(3)
  positions = (rng.normal(size=(300, 3)) * 1.5).astype(np.float32)
  found = fused.FusedField(field).densities(positions, sigma=0.01)
  variances = np.full((300, 3), 1e-4, np.float32)
  expected = query_density(field.settings, field.params, positions, variances)
  np.testing.assert_allclose(found, expected, rtol=2e-4)


def test_density_grid_has_order_xyz():
  field = _rough_field()
  grid = fused.density_grid(field, 5, [-0.5, -0.4, -0.3], [0.5, 0.8, 0.9], sigma=0.02)
  point = np.array([[-0.5 + 0.25 * 3, -0.4 + 0.3 * 1, -0.3 + 0.3 * 2]], np.float32)
  expected = query_density(field.settings, field.params, point, np.full((1, 3), 4e-4, np.float32))
  np.testing.assert_allclose(grid[3, 1, 2], expected[0], rtol=2e-4)


def test_render_agrees_with_a_sum_in_jax():
  field = _rough_field()
  evaluator = fused.FusedField(field, settings=SETTINGS)
  evaluator._engine.occupancy.inner_density[:] = 100.0
  evaluator._has_occupancy = True  # everything occupied: the march is regular
  origin, direction = np.array([[0.1, 0.2, -0.9]]), np.array([[0.0, 0.6, 0.8]])
  color, distance, opacity = evaluator.render_rays(origin, direction, pixel_angle=0.1)
  t, edges, lengths = SETTINGS.near + 0.05, [], []
  while t < fused_march.FAR:
    norm = np.abs(origin + (t + 0.05) * direction).max()
    length = 0.1 if norm < 1 else 0.2 * norm
    edges.append(t + length / 2)
    lengths.append(length)
    t += length
  edges = np.array(edges[: SETTINGS.ray_samples], np.float32)[None]
  lengths = np.array(lengths[: SETTINGS.ray_samples], np.float32)[None]
  positions = (origin + edges[..., None] * direction).astype(np.float32)
  along = np.broadcast_to(direction.astype(np.float32), positions.shape)
  told = _told_length(positions)
  variance = sample_variance(along, edges, told, pixel_angle=0.05, footprint=4.0)
  density, colors = query(field.settings, field.params, positions, variance, along)
  weights = sampling.interval_weights(density, lengths)
  np.testing.assert_allclose(color[0], (weights[..., None] * colors).sum(1)[0], atol=2e-3)
  np.testing.assert_allclose(opacity[0], weights.sum(), atol=2e-3)
  np.testing.assert_allclose(distance[0], sampling.expected_distance(weights, edges)[0], rtol=5e-3)


def test_chebyshev_distance_agrees_with_scipy():
  rng = np.random.default_rng(0)
  occupied = rng.random((20, 20, 20)) < 0.002
  found = fused_march.chebyshev_distance(occupied, limit=6)
  expected = np.minimum(distance_transform_cdt(~occupied, metric="chessboard"), 6)
  np.testing.assert_array_equal(found, expected)


def test_march_visits_every_occupied_cell_on_its_way():
  rng = np.random.default_rng(1)
  size = 16
  occupied = rng.random((size,) * 3) < 0.05
  distance = fused_march.chebyshev_distance(occupied, limit=6)
  grid = fused_march.Occupancy(
    size,
    distance.ravel(),
    np.zeros(size**3, np.float32),
    4,
    np.full(64, 6, np.uint8),
    np.zeros(64, np.float32),
  )
  step = 0.01
  for _ in range(20):
    origin = rng.uniform(-0.5, 0.5, 3).astype(np.float32)
    direction = rng.normal(size=3)
    direction = (direction / np.linalg.norm(direction)).astype(np.float32)
    distances, lengths = np.zeros(512, np.float32), np.zeros(512, np.float32)
    count = fused_march.march(
      grid,
      *origin,
      *direction,
      np.float32(0),
      np.float32(0),
      np.float32(step),
      np.float32(1e9),
      512,
      distances,
      lengths,
      0,
    )
    t = np.arange(step / 2, 3.5, step)
    points = origin + t[:, None] * direction
    points = points[np.abs(points).max(-1) < 1]
    cells = ((points + 1) * size / 2).astype(int)
    expected = np.flatnonzero(occupied[cells[:, 0], cells[:, 1], cells[:, 2]]).size
    assert abs(count - expected) <= 2  # rounding at the faces of cells
    np.testing.assert_allclose(lengths[:count], step)


def test_shapes_that_the_kernels_cannot_run_are_refused():
  with pytest.raises(ValueError, match=r"levels \* features = 10"):
    fused_engine.check_supported(FieldSettings(levels=5))
