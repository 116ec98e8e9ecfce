"""Exposure from shared points: gains that were put in are found, fixed exposure is left alone."""

import numpy as np
import pytest

from nerf2real.scenes.field import photometry


def _observations(gains, *, noise, outliers=0.0, seed=0):
  """Chains of pictures that share points with their neighbours only, as in a video."""
  rng = np.random.default_rng(seed)
  count = len(gains)
  pictures, points, colors = [], [], []
  for point in range(60 * count):
    first = rng.integers(0, count - 3)
    color = rng.uniform(40, 150, 3)
    for picture in range(first, first + 4):
      seen = color * gains[picture] * np.exp(rng.normal(scale=noise, size=3))
      if rng.random() < outliers:
        seen = rng.uniform(20, 240, 3)
      pictures.append(picture)
      points.append(7 * point)
      colors.append(seen)
  return np.array(pictures), np.array(points), np.array(colors)


def test_gains_of_a_changing_exposure_are_found():
  t = np.linspace(0, 1, 40)[:, None]
  gains = np.exp(0.4 * np.sin(5 * t + [0.0, 0.2, 0.4]))
  gains /= np.exp(np.log(gains).mean(0))
  found = photometry.picture_gains(
    *_observations(gains, noise=0.03, outliers=0.1), count=len(gains)
  )
  # Neighbours share points; over the whole chain errors add up and the prior pulls a little.
  np.testing.assert_allclose(
    np.diff(np.log(found), axis=0), np.diff(np.log(gains), axis=0), atol=0.02
  )
  np.testing.assert_allclose(found, gains, rtol=0.08)


def test_a_fixed_exposure_stays_exactly_one():
  found = photometry.picture_gains(*_observations(np.ones((20, 3)), noise=0.05), count=20)
  np.testing.assert_array_equal(found, 1.0)


def test_no_observations_give_no_gains():
  nothing = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3))
  np.testing.assert_array_equal(photometry.picture_gains(*nothing, count=5), np.ones((5, 3)))


@pytest.mark.parametrize("gain", [0.6, 1.7])
def test_evening_out_inverts_exposing_where_nothing_clips(gain):
  image = np.arange(20, 140, dtype=np.uint8).reshape(4, 10, 3)
  factor = np.array([gain, 1.0, 1 / gain])
  shown = photometry.expose(image, factor)
  unclipped = shown < 235
  back = photometry.even_out(shown, factor)
  np.testing.assert_allclose(back[unclipped], image[unclipped], atol=1.0)


def test_clipped_values_stay_bright():
  white = np.full((2, 2, 3), 255, np.uint8)
  np.testing.assert_array_equal(photometry.even_out(white, np.full(3, 1.6)), white)


def test_exposure_ratio_by_hand():
  assert photometry.exposure_ratio(None) == 1.0
  gains = np.linspace(1.0, 3.0, 101)[:, None].repeat(3, axis=1)
  np.testing.assert_allclose(photometry.exposure_ratio(gains), 2.9 / 1.1)
