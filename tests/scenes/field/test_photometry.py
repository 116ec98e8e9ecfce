"""Exposure from shared points: what was put in is found, fixed exposure is left alone."""

import numpy as np
import pytest

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field import photometry

CAMERA = Camera(width=16, height=8, fx=10, fy=10, cx=8, cy=4)
FALLOFF = np.array([[-0.9, 0.1, -0.2], [-0.7, 0.0, -0.2], [-1.1, 0.4, -0.3]])


def _observations(gains, *, noise, outliers=0.0, seed=0, falloff=None):
  """Chains of pictures that share points with their neighbours only, as in a video."""
  falloff = np.zeros((3, 3)) if falloff is None else falloff
  rng = np.random.default_rng(seed)
  count = len(gains)
  pictures, points, colors, radii = [], [], [], []
  for point in range(60 * count):
    first = rng.integers(0, count - 3)
    color = rng.uniform(40, 150, 3)
    for picture in range(first, first + 4):
      radius = np.sqrt(rng.uniform())
      light = np.exp(falloff @ [radius**2, radius**4, radius**6])
      seen = color * gains[picture] * light * np.exp(rng.normal(scale=noise, size=3))
      if rng.random() < outliers:
        seen = rng.uniform(20, 240, 3)
      pictures.append(picture)
      points.append(7 * point)
      colors.append(seen)
      radii.append(radius)
  return photometry.Sightings(*map(np.array, (pictures, points, colors, radii)))


def test_gains_of_a_changing_exposure_are_found():
  t = np.linspace(0, 1, 40)[:, None]
  gains = np.exp(0.4 * np.sin(5 * t + [0.0, 0.2, 0.4]))
  gains /= np.exp(np.log(gains).mean(0))
  seen = _observations(gains, noise=0.03, outliers=0.1)
  exposure = photometry.fit_exposure(seen, count=len(gains))
  found = exposure.gains
  # Neighbours share points; over the whole chain errors add up and the prior pulls a little.
  np.testing.assert_allclose(
    np.diff(np.log(found), axis=0), np.diff(np.log(gains), axis=0), atol=0.02
  )
  np.testing.assert_allclose(found, gains, rtol=0.08)
  assert exposure.changes and not exposure.falloff.any()


def test_a_falloff_is_found_beside_a_changing_exposure():
  t = np.linspace(0, 1, 40)[:, None]
  gains = np.exp(0.3 * np.sin(5 * t + [0.0, 0.2, 0.4]))
  gains /= np.exp(np.log(gains).mean(0))
  seen = _observations(gains, noise=0.03, outliers=0.1, falloff=FALLOFF)
  found = photometry.fit_exposure(seen, count=len(gains))
  np.testing.assert_allclose(found.gains, gains, rtol=0.08)
  powers = np.linspace(0, 1, 20)[:, None] ** [2, 4, 6]
  np.testing.assert_allclose(powers @ found.falloff.T, powers @ FALLOFF.T, atol=0.03)
  assert found.corner == pytest.approx(np.exp(FALLOFF.sum(-1)).mean(), rel=0.03)


def test_a_fixed_exposure_stays_exactly_one():
  found = photometry.fit_exposure(_observations(np.ones((20, 3)), noise=0.05), count=20)
  np.testing.assert_array_equal(found.gains, 1.0)
  assert found.is_even


def test_no_observations_give_no_exposure():
  nothing = photometry.Sightings(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0))
  found = photometry.fit_exposure(nothing, count=5)
  assert found.is_even and found.gains.shape == (5, 3)


def test_factors_fall_off_from_the_principal_point():
  exposure = photometry.Exposure(np.array([[1.0, 2.0, 3.0]]), FALLOFF)
  factors = exposure.factors(0, CAMERA)
  assert factors.shape == (8, 16, 3)
  radius = np.hypot(7.5, 3.5) / np.hypot(8, 4)
  corner = [1.0, 2.0, 3.0] * np.exp(FALLOFF @ [radius**2, radius**4, radius**6])
  np.testing.assert_allclose(factors[0, 0], corner, rtol=1e-5)
  np.testing.assert_allclose(factors[::-1, ::-1], factors, rtol=1e-5)
  half = exposure.factors(0, CAMERA.resized(8, 4))
  np.testing.assert_allclose(half[2, 4], factors[4:6, 8:10].mean((0, 1)), rtol=0.02)


def test_evened_pictures_keep_their_bright_values():
  """A dark picture of a bright thing: its exposure is not raised beyond what a byte holds."""
  images = np.full((2, 8, 16, 3), 200, np.uint8)
  exposure = photometry.Exposure(np.array([[0.5] * 3, [1.0] * 3]), np.zeros((3, 3)))
  raised = exposure.for_range(images, CAMERA)
  np.testing.assert_allclose(raised.gains[1] / raised.gains[0], 2.0)
  evened = photometry.even_out(images[0], raised.factors(0, CAMERA))
  assert 245 < evened.min() <= evened.max() <= 255
  even = photometry.Exposure(np.ones((2, 3)), np.zeros((3, 3)))
  assert even.for_range(images, CAMERA) is even


@pytest.mark.parametrize("gain", [0.6, 1.7])
def test_evening_out_inverts_exposing_where_nothing_clips(gain):
  image = np.arange(20, 140, dtype=np.uint8).reshape(4, 10, 3)
  factor = np.full((4, 10, 3), [gain, 1.0, 1 / gain], np.float32)
  shown = photometry.expose(image, factor)
  unclipped = shown < 235
  back = photometry.even_out(shown, factor)
  np.testing.assert_allclose(back[unclipped], image[unclipped], atol=1.0)


def test_clipped_values_stay_bright():
  white = np.full((2, 2, 3), 255, np.uint8)
  np.testing.assert_array_equal(photometry.even_out(white, np.full((2, 2, 3), 1.6)), white)


def test_exposure_ratio_by_hand():
  gains = np.linspace(1.0, 3.0, 101)[:, None].repeat(3, axis=1)
  np.testing.assert_allclose(photometry.Exposure(gains, np.zeros((3, 3))).ratio, 2.9 / 1.1)
