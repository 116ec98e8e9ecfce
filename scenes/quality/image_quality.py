"""Image quality of a rendered picture against the true one: PSNR and SSIM."""

import numpy as np
import skimage.metrics

_BEST_PSNR_DB = 100.0  # identical pictures, which have no finite figure


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
  """Peak signal-to-noise ratio [dB] of uint8 pictures [..., 3]: -10 log10(mean squared error)."""
  _check(picture, truth)
  error = np.mean(np.square((picture.astype(np.float64) - truth) / 255.0))
  return float(min(-10 * np.log10(max(error, 1e-300)), _BEST_PSNR_DB))


def ssim(picture: np.ndarray, truth: np.ndarray) -> float:
  """Structural similarity of uint8 pictures [H, W, 3] with Gaussian windows.

  Source: Wang et al. 2004, Image quality assessment: from error visibility to structural
  similarity; their constants, windows of 11 pixels with a deviation of 1.5.
  """
  _check(picture, truth)
  value = skimage.metrics.structural_similarity(
    picture,
    truth,
    channel_axis=-1,
    data_range=255,
    gaussian_weights=True,
    sigma=1.5,
    use_sample_covariance=False,
  )
  return float(value)


def _check(picture: np.ndarray, truth: np.ndarray) -> None:
  if picture.shape != truth.shape or picture.dtype != np.uint8 or truth.dtype != np.uint8:
    raise ValueError(
      f"Found pictures {picture.dtype} {picture.shape} and {truth.dtype} {truth.shape}; expected "
      "two uint8 pictures of the same shape."
    )
