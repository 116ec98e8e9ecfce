"""The belief as a heat map seen from above: white X the truth, green triangle the target.

Source: Byravan et al. 2022 (NeRF2Real), figure "Localization performance of the agent". Works on
NumPy arrays of one state's mixture: logits [M], means [M, 3], stddevs [M, 3].
"""

import numpy as np

from nerf2real.core.floor_map import Extent, FloorMap

_TRUTH, _TARGET = (255, 255, 255), (0, 200, 0)


def position_density(
  logits: np.ndarray, means: np.ndarray, stddevs: np.ndarray, *, extent: Extent, cell: float = 0.05
) -> np.ndarray:
  """Density [1/m^2] of x, y on a grid [rows, columns]; row 0 is at the largest y, as on a map."""
  x_from, x_to, y_from, y_to = extent
  x = np.arange(x_from + cell / 2, x_to, cell)
  y = np.arange(y_from + cell / 2, y_to, cell)[::-1]
  share = np.exp(logits - logits.max())
  share = share / share.sum()
  density = np.zeros((len(y), len(x)))
  for weight, mean, stddev in zip(share, means, stddevs, strict=True):
    along_x = np.exp(-0.5 * ((x - mean[0]) / stddev[0]) ** 2) / (stddev[0] * np.sqrt(2 * np.pi))
    along_y = np.exp(-0.5 * ((y - mean[1]) / stddev[1]) ** 2) / (stddev[1] * np.sqrt(2 * np.pi))
    density += weight * along_y[:, None] * along_x[None, :]
  return density


def draw(
  floor: FloorMap,
  logits: np.ndarray,
  means: np.ndarray,
  stddevs: np.ndarray,
  *,
  truth: np.ndarray | None = None,
  target: np.ndarray | None = None,
) -> np.ndarray:
  """Returns the density over a floor as a picture, RGB uint8 [H, W, 3].

  Args:
    floor: The floor, which is not changed.
    logits: Of the mixture [M].
    means: [M, 3].
    stddevs: [M, 3].
    truth: True x, y [m], drawn as a white X.
    target: The target's x, y [m], drawn as a green triangle.
  """
  drawn = floor.copy().heat(position_density(logits, means, stddevs, extent=floor.extent))
  if target is not None:
    drawn.triangle(target, _TARGET)
  if truth is not None:
    drawn.cross(truth, _TRUTH)
  return drawn.picture
