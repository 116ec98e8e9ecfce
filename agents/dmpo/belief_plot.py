"""The belief as a heat map seen from above: white X the truth, green triangle the target.

Source: Byravan et al. 2022 (NeRF2Real), figure "Localization performance of the agent". Works on
NumPy arrays of one state's mixture: logits [M], means [M, 3], stddevs [M, 3].
"""

import cv2
import numpy as np

Extent = tuple[float, float, float, float]  # x from, x to, y from, y to [m]
_MARKER_SIZE = 0.025  # of the picture's longer side


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


def draw_heat_map(
  density: np.ndarray,
  *,
  extent: Extent,
  truth: np.ndarray | None = None,
  target: np.ndarray | None = None,
  background: np.ndarray | None = None,
  pixels_per_cell: int = 6,
) -> np.ndarray:
  """Draws a density [rows, columns] as a picture uint8 [H, W, 3] in RGB.

  Args:
    density: from `position_density`.
    extent: the same extent.
    truth: true x, y [m], drawn as a white X.
    target: the target's x, y [m], drawn as a green triangle.
    background: map of the scene over the same extent, uint8 [.., .., 3], dimmed below the heat.
    pixels_per_cell: edge of a cell in the picture [pixels].
  """
  height, width = density.shape[0] * pixels_per_cell, density.shape[1] * pixels_per_cell
  share = (density / max(float(density.max()), 1e-12)).astype(np.float32)
  level = np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))
  colour = np.asarray(cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO))
  picture = np.ascontiguousarray(colour[..., ::-1])
  if background is not None:
    below = np.asarray(cv2.resize(background, (width, height), interpolation=cv2.INTER_AREA))
    opacity = np.clip(2 * level, 0, 1)[..., None]
    picture = (opacity * picture + (1 - opacity) * 0.6 * below).astype(np.uint8)
  size = max(3, round(_MARKER_SIZE * max(height, width)))
  if target is not None:
    column, row = _pixel(target, extent, picture.shape)
    corners = [(column, row - size), (column - size, row + size), (column + size, row + size)]
    cv2.fillPoly(picture, [np.array(corners, np.int32)], (0, 200, 0))
  if truth is not None:
    column, row = _pixel(truth, extent, picture.shape)
    for sign in (-1, 1):
      ends = (column - size, row - sign * size), (column + size, row + sign * size)
      cv2.line(picture, *ends, (255, 255, 255), max(1, size // 3), cv2.LINE_AA)
  return picture


def _pixel(position: np.ndarray, extent: Extent, shape: tuple[int, ...]) -> tuple[int, int]:
  x_from, x_to, y_from, y_to = extent
  column = (position[0] - x_from) / (x_to - x_from) * shape[1]
  row = (y_to - position[1]) / (y_to - y_from) * shape[0]
  return round(float(column)), round(float(row))
