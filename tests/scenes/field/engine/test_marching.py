"""Rays' march through the occupancy grids, and the distances that it skips by."""

import numpy as np
import warp as wp
from scipy.ndimage import distance_transform_cdt

from nerf2real.scenes.field.engine import layout, occupancy
from nerf2real.scenes.field.engine.device import OPTIONS, Device
from nerf2real.scenes.field.engine.rays import march


def _distances(occupied):
  device = Device()
  result = device.zeros(occupied.size, np.uint8)
  occupancy.distances(device, occupied, result)
  return result.numpy().reshape(occupied.shape)


def test_distances_agree_with_scipy():
  occupied = np.random.default_rng(0).random((20, 20, 20)) < 0.002
  expected = np.minimum(distance_transform_cdt(~occupied, metric="chessboard"), 12)
  np.testing.assert_array_equal(_distances(occupied), expected)


@wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
def _march(
  grids: layout.Occupancy,
  settings: layout.Settings,
  origins: wp.array(dtype=wp.vec3),
  directions: wp.array(dtype=wp.vec3),
  samples: wp.array(dtype=wp.float32),
  stride: wp.int32,
  counts: wp.array(dtype=wp.int32),
):
  ray = wp.tid()
  count, _cut = march(
    grids, settings, origins[ray], directions[ray], 0.0, 1e9, samples, stride, ray * 512
  )
  counts[ray] = count


def test_march_visits_every_occupied_cell_on_its_way():
  rng = np.random.default_rng(1)
  size, rays, step = 16, 20, 0.01
  occupied = rng.random((size,) * 3) < 0.05
  device = Device()
  grids, settings = layout.Occupancy(), layout.Settings()
  grids.inner_size, grids.outer_size = size, 4
  grids.inner_distance = device.put(_distances(occupied).ravel())
  grids.inner_density = device.zeros(size**3)
  grids.outer_distance = device.put(np.full(64, 6, np.uint8))
  grids.outer_density = device.zeros(64)
  settings.step, settings.ray_samples = step, 512
  origins = rng.uniform(-0.5, 0.5, (rays, 3)).astype(np.float32)
  directions = rng.normal(size=(rays, 3))
  directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
  samples, counts = device.zeros(2 * rays * 512), device.zeros(rays, np.int32)
  places = device.put(origins, wp.vec3), device.put(directions, wp.vec3)
  device.launch(_march, [grids, settings, *places, samples, rays * 512, counts], dim=rays)
  lengths = samples.numpy().reshape(2, rays, 512)[1]
  for ray, count in enumerate(counts.numpy()):
    t = np.arange(step / 2, 3.5, step)
    points = origins[ray] + t[:, None] * directions[ray]
    points = points[np.abs(points).max(-1) < 1]
    cells = ((points + 1) * size / 2).astype(int)
    expected = np.flatnonzero(occupied[cells[:, 0], cells[:, 1], cells[:, 2]]).size
    assert abs(count - expected) <= 2  # rounding at the faces of cells
    np.testing.assert_allclose(lengths[ray, :count], step)


def test_a_ray_at_the_last_number_below_one_stays_in_the_grid():
  """What lies behind the grid in memory is full, the grid is empty."""
  size, outer = 8, 4
  device = Device()
  distances = device.put(np.array([12] * size**3 + [0] * (size**2 + size + 1), np.uint8))
  grids, settings = layout.Occupancy(), layout.Settings()
  grids.inner_size, grids.outer_size = size, outer
  grids.inner_distance = distances[: size**3]
  grids.inner_density = device.zeros(distances.size)[: size**3]
  grids.outer_distance = device.put(np.full(outer**3, 6, np.uint8))
  grids.outer_density = device.zeros(outer**3)
  settings.step, settings.ray_samples = 0.01, 512
  below = np.nextafter(np.float32(1), np.float32(0))
  origin = device.put(np.array([[below, below, -0.9]], np.float32), wp.vec3)
  direction = device.put(np.array([[0.0, 0.0, 1.0]], np.float32), wp.vec3)
  samples, counts = device.zeros(1024), device.zeros(1, np.int32)
  device.launch(_march, [grids, settings, origin, direction, samples, 512, counts], dim=1)
  assert counts.numpy()[0] == 0
