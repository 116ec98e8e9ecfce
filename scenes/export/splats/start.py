"""Places splats on the surface that a field's pictures show, densest where the camera comes near.

Shapes: N splats, P pixels.
"""

from typing import NamedTuple

import cv2
import numpy as np

from nerf2real.scenes.export.splats.splats import Splats
from nerf2real.scenes.geometry import fusion

_OCTAVE = np.sqrt(2.0)  # ratio of neighbouring spacings
_THICKNESS = 0.25  # of a splat along the normal, of its width; chosen: flat, but not singular
_WIDTH = 0.6  # standard deviation along the surface, of the spacing: neighbours overlap
_OPACITY = 0.8
_WINDOW = 3  # pixels across which the colour's deviation is taken
_CONTRAST = 0.04  # deviation of a colour, 0 to 1, from which on splats are as fine as pixels
_COARSEST = 4.0  # factor on the spacing where the colour does not change


class Seeds(NamedTuple):
  """Points on the surface."""

  positions: np.ndarray  # [N, 3] m
  normals: np.ndarray  # towards the camera [N, 3]
  colors: np.ndarray  # 0 to 1 [N, 3]
  spacing: np.ndarray  # distance of neighbours [N] [m]


def seeds(views: fusion.DepthViews, *, far: float, spacing: float) -> Seeds:
  """Lifts every pixel of pictures to a point.

  Its spacing is its pixel's width there, and more where the colour hardly changes.

  Args:
    views: Pictures with depth and colour, world frame.
    far: Depth given to pixels in which nothing was hit [m].
    spacing: Multiplies the pixels' widths.
  """
  assert views.color is not None
  rays = views.camera.rays()
  found: list[tuple[np.ndarray, ...]] = []
  for pose, depth, color in zip(views.frame_from_camera, views.depth, views.color, strict=True):
    known = np.where(np.isfinite(depth), depth, far).astype(np.float32)
    normal, cosine = fusion.pixel_normals(known, rays)
    facing = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    normal = np.where((cosine > 0)[..., None], normal, facing)
    size = spacing * known * views.camera.pixel_angle * _plainness(color, cosine)
    points = (rays * known[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    turned = normal.reshape(-1, 3) @ pose[:3, :3].T
    found.append((points.reshape(-1, 3), turned, color.reshape(-1, 3) / 255.0, size.ravel()))
  return Seeds(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _plainness(color: np.ndarray, cosine: np.ndarray) -> np.ndarray:
  """Factor [H, W] on the spacing: 1 at edges of things and of colours, more where it is plain."""
  values = color.astype(np.float32) / 255
  size = (_WINDOW, _WINDOW)
  variance = cv2.blur(values**2, size) - cv2.blur(values, size) ** 2
  deviation = np.sqrt(np.maximum(variance.max(-1), 1e-8))
  plain = np.clip(_CONTRAST / deviation, 1, _COARSEST)
  factor: np.ndarray = np.where(cosine > 0, plain, 1.0)
  return factor


def _cells(positions: np.ndarray, edge: float) -> np.ndarray:
  """Number [N] of the cell in which each position lies."""
  cells = np.floor(positions / edge).astype(np.int64)
  cells -= cells.min(0)
  size = cells.max(0) + 1
  number: np.ndarray = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
  return number


def thin(points: Seeds, *, finest: float) -> Seeds:
  """Keeps one point in each cell as wide as its spacing; finer points take the place of coarser.

  Args:
    points: All points.
    finest: Least spacing [m].
  """
  level = np.ceil(np.log(np.maximum(points.spacing, finest) / finest) / np.log(_OCTAVE)).astype(int)
  kept: list[np.ndarray] = []
  for step in range(int(level.max()) + 1):
    edge = finest * _OCTAVE**step
    taken = np.concatenate(kept) if kept else np.zeros(0, int)
    offered = np.flatnonzero(level == step)
    if not len(offered):
      continue
    cells = _cells(points.positions[np.concatenate([taken, offered])], edge)
    _, first = np.unique(cells, return_index=True)
    kept.append(offered[np.sort(first[first >= len(taken)]) - len(taken)])
  chosen = np.concatenate(kept)
  widths = finest * _OCTAVE ** level[chosen]
  return Seeds(points.positions[chosen], points.normals[chosen], points.colors[chosen], widths)


def thin_to(points: Seeds, *, count: int, finest: float) -> Seeds:
  """Thins with a spacing that grows until at most `count` points are left."""
  found = thin(points, finest=finest)
  while len(found.positions) > count:
    factor = max(1.03, np.sqrt(len(found.positions) / count))
    points = points._replace(spacing=points.spacing * factor)
    finest *= factor
    found = thin(points, finest=finest)
  return found


def rows_of(points: Seeds) -> np.ndarray:
  """Packed parameters [N, 14] of flat splats on the points, their third axis along the normal."""
  count = len(points.positions)
  normals = points.normals / np.linalg.norm(points.normals, axis=-1, keepdims=True)
  # the quaternion that turns z to the normal: (1 + z . n, z x n), a half turn where opposite
  quaternions = np.stack(
    [1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], axis=-1
  )
  quaternions[normals[:, 2] < -1 + 1e-6] = [0, 1, 0, 0]
  quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
  widths = _WIDTH * points.spacing[:, None] * np.array([1, 1, _THICKNESS])
  logits = np.full((count, 1), np.log(_OPACITY / (1 - _OPACITY)))
  columns = [np.zeros((count, 3)), np.log(widths), quaternions, logits, points.colors]
  return np.concatenate(columns, axis=1).astype(np.float32)


def splats_of(rows: np.ndarray, points: Seeds) -> Splats:
  """Returns the splats of fitted parameters [N, 14]."""
  columns = np.split(rows.astype(np.float64), [3, 6, 10, 11], axis=1)
  offsets, log_scales, rotations, logits, colors = columns
  return Splats(
    positions=points.positions + points.spacing[:, None] * offsets,
    rotations=rotations / np.linalg.norm(rotations, axis=-1, keepdims=True),
    scales=np.exp(log_scales),
    opacities=1 / (1 + np.exp(-logits[:, 0])),
    colors=colors,
  )
