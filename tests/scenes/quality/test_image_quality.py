import numpy as np
import pytest

from nerf2real.scenes.quality import image_quality


def test_psnr_by_hand():
  truth = np.zeros((4, 5, 3), np.uint8)
  picture = truth + np.uint8(51)  # an error of 0.2 everywhere: 10 log10(25)
  assert image_quality.psnr(picture, truth) == pytest.approx(13.9794, abs=1e-4)
  assert image_quality.psnr(truth, truth) == 100.0


def test_ssim_is_one_for_equal_pictures_and_falls_with_noise():
  rng = np.random.default_rng(0)
  truth = rng.integers(0, 255, (32, 32, 3)).astype(np.uint8)
  noisy = np.clip(truth + rng.normal(0, 40, truth.shape), 0, 255).astype(np.uint8)
  assert image_quality.ssim(truth, truth) == pytest.approx(1.0)
  assert image_quality.ssim(noisy, truth) < 0.95


def test_pictures_must_match():
  with pytest.raises(ValueError, match="same shape"):
    image_quality.psnr(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3, 3), np.uint8))
