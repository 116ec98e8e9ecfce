"""The surfaces that depth pictures show, on a grid of cells of several pixels.

Shapes: H x W cells.
"""

import numpy as np

_CELLS = 160  # across a picture, chosen: of 640 pixels four times four
_MEASURED = 0.75  # of a cell's pixels, or its depth is none
_ACROSS = 2  # cells to those on whose differences a normal rests
_FLAT = 0.02  # of its depth that a cell may lie off the middle of these, or it is at an edge


def cells(depth: np.ndarray, unit: float) -> np.ndarray:
  """Returns the depth [H, W] [m] of cells, the median of their pixels; NaN where few are measured.

  Args:
    depth: z-depth of a picture, 0 where nothing was measured.
    unit: Its unit [m].
  """
  side = max(1, round(depth.shape[1] / _CELLS))
  height, width = (size // side for size in depth.shape)
  blocks = depth[: height * side, : width * side].reshape(height, side, width, side)
  pixels = blocks.transpose(0, 2, 1, 3).reshape(height, width, -1)
  ordered = np.sort(pixels, axis=-1)  # what was not measured comes first
  count = (pixels > 0).sum(axis=-1)
  middle = np.minimum(side * side - (count + 1) // 2, side * side - 1)
  median = np.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0] * unit
  return np.where(count >= _MEASURED * side * side, median, np.nan).astype(np.float32)


def normals(depth: np.ndarray, rays: np.ndarray) -> np.ndarray:
  """Returns unit normals [H, W, 3] of cells, towards the camera; NaN at edges and beside holes.

  Args:
    depth: Of the cells [H, W] [m], NaN for none.
    rays: Of the cells [H, W, 3].
  """
  points, near = rays * depth[..., None], _ACROSS
  result = np.full(points.shape, np.nan)
  inner = (slice(near, -near), slice(near, -near))
  left, right = points[near:-near, : -2 * near], points[near:-near, 2 * near :]
  above, below = points[: -2 * near, near:-near], points[2 * near :, near:-near]
  normal = np.cross(right - left, below - above)
  normal *= -np.sign(np.sum(normal * points[inner], axis=-1, keepdims=True))
  middle = depth[inner]
  off = [np.abs(middle - 0.5 * (a + b)[..., 2]) for a, b in ((left, right), (above, below))]
  flat = np.maximum(*off) < _FLAT * middle
  length = np.linalg.norm(normal, axis=-1, keepdims=True)
  with np.errstate(divide="ignore", invalid="ignore"):
    result[inner] = np.where(flat[..., None], normal / length, np.nan)
  return result
