"""Estimates the width of a picture's blur from its edges, in the direction of the widest.

The gradient of an edge with a blur of deviation s, blurred further by a, is in proportion to
1 / sqrt(s^2 + a^2): the ratio r of two such gradients gives s^2 = (b^2 - r^2 a^2) / (r^2 - 1). It
does not depend on how much contrast a picture has, as the variance of its Laplacian does: a plain
wall in focus is sharp. A hand's motion blurs the edges across it alone, so the strongest edges of
each direction are looked at by themselves.

Source: Zhuo and Sim 2011, Defocus map estimation from a single image, section 3.
"""

import cv2
import numpy as np

from nerf2real.scenes.capture.media.video import at_standard_size

# Deviations of the two further blurs [pixel]; chosen: for widths of 0.5 to 7.
_LESS, _MORE = 1.0, 2.5
_DIRECTIONS = 4
_STRONGEST = 0.03  # share of a direction's pixels that are taken for its edges
_FEWEST = 20  # of them that say something
_FAINTEST = 0.5  # gradient [grey levels a pixel] below which there is noise
_BORDER = 8  # pixels at the border, where a blur has only half of its support


def _gradient(picture: np.ndarray, deviation: float) -> tuple[np.ndarray, np.ndarray]:
  """Size and direction (0 to pi) of the gradient of a picture that is blurred further."""
  blurred = cv2.GaussianBlur(picture, (0, 0), deviation)
  x, y = (cv2.Sobel(blurred, -1, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
  inner = (slice(_BORDER, -_BORDER),) * 2
  return np.hypot(x, y)[inner], np.arctan2(y, x)[inner] % np.pi


def blur_width(grey: np.ndarray) -> float:
  """Blur of a grey picture [H, W] at the standard size, as that of a Gaussian with its slopes.

  Returns:
    Its standard deviation [pixel] along the direction in which it is widest; the shorter side of a
    picture without edges.
  """
  picture = at_standard_size(grey).astype(np.float32)
  (less, angle), (more, _) = (_gradient(picture, deviation) for deviation in (_LESS, _MORE))
  found = []
  for number in range(_DIRECTIONS):
    turned = (angle - number * np.pi / _DIRECTIONS + np.pi / 2) % np.pi - np.pi / 2
    sizes = np.where(np.abs(turned) < np.pi / _DIRECTIONS / 2, less, 0.0)
    clear = sizes[sizes > _FAINTEST]
    if _STRONGEST * len(clear) < _FEWEST:
      continue
    strong = sizes >= np.quantile(clear, 1 - _STRONGEST)
    ratio = max(float(np.median(less[strong] / more[strong])), 1.0 + 1e-6)
    square = (_MORE**2 - ratio**2 * _LESS**2) / (ratio**2 - 1)
    found.append(float(np.sqrt(max(square, 0.0))))
  return min(max(found, default=np.inf), float(min(picture.shape)))
