import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.special import sph_harm_y

from nerf2real.scenes.field import encoding


def test_dense_level_agrees_with_scipy():
  rng = np.random.default_rng(0)
  resolution, entries = 5, 256  # 6^3 = 216 vertices
  table = rng.normal(size=(1, entries, 2)).astype(np.float32)
  grid = table[0, :216].reshape(6, 6, 6, 2).transpose(2, 1, 0, 3)  # x was fastest
  axis = np.linspace(0, 1, 6)
  points = rng.uniform(size=(200, 3)).astype(np.float32)
  expected = RegularGridInterpolator((axis, axis, axis), grid)(points)
  found = encoding.hash_encode(jnp.asarray(table), points, resolutions=(resolution,))
  np.testing.assert_allclose(found, expected, atol=2e-6)


def test_hash_agrees_with_python_integers():
  vertices = np.array([[3, 70, 11], [1000, 1023, 512]], np.uint32)
  found = encoding.entry_index(jnp.asarray(vertices), resolution=1024, entries=2**18)
  for row, (x, y, z) in zip(np.asarray(found), vertices.tolist(), strict=True):
    mixed = x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)
    assert row == mixed % 2**18


def test_upper_faces_stay_inside_the_table():
  table = np.random.default_rng(0).normal(size=(1, 512, 2)).astype(np.float32)
  at_corner = encoding.hash_encode(
    jnp.asarray(table), np.ones((1, 3), np.float32), resolutions=(7,)
  )
  np.testing.assert_allclose(at_corner[0], table[0, 511], rtol=1e-6)


def test_resolutions_must_match_the_table():
  with pytest.raises(ValueError, match="2 levels but 1"):
    encoding.hash_encode(jnp.zeros((2, 16, 2)), np.zeros((1, 3)), resolutions=(2,))


def test_spherical_harmonics_agree_with_scipy():
  rng = np.random.default_rng(1)
  directions = rng.normal(size=(50, 3))
  directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
  polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
  expected = []
  for degree in range(3):
    for order in range(-degree, degree + 1):
      value = sph_harm_y(degree, abs(order), polar, azimuth)
      part = value.imag if order < 0 else value.real
      # scipy's phase gives the sign -1 to odd orders, as the usual real form in graphics has it.
      expected.append(part * (np.sqrt(2) if order else 1))
  found = np.asarray(encoding.spherical_harmonics(directions.astype(np.float32)))
  np.testing.assert_allclose(found, np.stack(expected, -1), atol=2e-6)


def test_variance_of_a_sample_by_monte_carlo():
  rng = np.random.default_rng(2)
  direction = np.array([0.0, 0.0, 1.0], np.float32)
  distance, length, angle = 2.0, 0.5, 0.01
  pixels = rng.uniform(-0.5, 0.5, (200_000, 2)) * angle * distance
  along = rng.uniform(-0.5, 0.5, 200_000) * length
  expected = [pixels[:, 0].var(), pixels[:, 1].var(), along.var()]
  found = encoding.sample_variance(
    direction, jnp.float32(distance), jnp.float32(length), pixel_angle=angle
  )
  np.testing.assert_allclose(found, expected, rtol=0.02)


def test_blur_widens_a_pixel_by_its_variance():
  assert float(encoding.blur_footprint(jnp.float32(2.0))) == 49.0


@pytest.mark.parametrize("cells", [7, 40])
def test_level_rows_index_as_entry_index_does(cells):
  entries = 1 << 10
  y_stride, z_stride, mask, found_cells = encoding.level_rows([3, cells], entries)[:, 1]
  vertices = np.random.default_rng(0).integers(0, cells + 1, (50, 3)).astype(np.uint32)
  x, y, z = vertices[:, 0], vertices[:, 1] * y_stride, vertices[:, 2] * z_stride
  row = (x ^ y ^ z) & mask if mask else x + y + z
  expected = encoding.entry_index(jnp.asarray(vertices), resolution=cells, entries=entries)
  np.testing.assert_array_equal(row, expected)
  assert found_cells == cells and (mask == 0) == encoding.is_dense(cells, entries)
