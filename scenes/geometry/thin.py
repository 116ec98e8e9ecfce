"""Finds what is too thin for fused depth: chair legs, poles of lamps, leaves.

In a depth picture a thing a few pixels wide is silhouette all over, and the depth of silhouettes is
trusted to free space only (`scenes.geometry.fusion`). So pictures vote: a voxel where several see a
thin thing, and no more see through it, is matter. Shapes: H height, W width, C voxels.
"""

import cv2
import numpy as np

from nerf2real.scenes.geometry import fusion

_SUPPORT = 7  # pixels: what is narrower has no normal, which is of a 5x5 median and a 3x3 blur
_FEWEST_VIEWS = 3  # that see a thin thing in the same voxel: two agree by chance
_FAR = 1e9  # depth of pixels where nothing was hit
_VALUE = -0.3  # of a thin voxel; its surface lies a quarter of a voxel from its centre


def thin_pixels(depth: np.ndarray) -> np.ndarray:
  """Returns the pixels of things narrower than seven pixels before something far behind them.

  Args:
    depth: Depth picture [H, W]; 0, inf or nan: nothing was hit.

  Returns:
    bool [H, W]. Within three pixels of the border none are: what is cut off there may be wide.
  """
  hit = np.isfinite(depth) & (depth > 0)
  far = np.where(hit, depth, _FAR).astype(np.float32)
  closed = cv2.morphologyEx(far, cv2.MORPH_CLOSE, np.ones((_SUPPORT, _SUPPORT), np.uint8))
  thin = (closed - far > fusion.EDGE * far) & hit
  border = _SUPPORT // 2
  thin[:border] = thin[-border:] = thin[:, :border] = thin[:, -border:] = False
  return thin


def thin_voxels(views: fusion.DepthViews, grid: fusion.Grid) -> np.ndarray:
  """Returns the indices [C, 3] of voxels that hold a thin thing.

  At least three pictures see one there, and no more pictures see through the voxel: to what lies
  farther behind its centre than the grid's truncation, in all of the nine pixels about it.
  """
  rays = views.camera.rays()
  shape = np.array(grid.values.shape)
  votes = np.zeros(shape, np.int32)
  for pose, depth in zip(views.frame_from_camera, views.depth, strict=True):
    thin = thin_pixels(depth)
    points = (rays[thin] * depth[thin, None]) @ pose[:3, :3].T + pose[:3, 3]
    index = np.round((points - grid.lower) / grid.voxel).astype(int)
    index = np.unique(index[((index >= 0) & (index < shape)).all(1)], axis=0)
    votes[tuple(index.T)] += 1
  found = np.argwhere(votes >= _FEWEST_VIEWS)
  through = _views_through(views, grid.lower + grid.voxel * found, grid.truncation)
  return found[through <= votes[tuple(found.T)]]


def _views_through(views: fusion.DepthViews, places: np.ndarray, margin: float) -> np.ndarray:
  """Counts the pictures that see more than a margin beyond places [C, 3]."""
  camera = views.camera
  size = np.array([camera.width, camera.height])
  widest = np.square(camera.rays()[..., :2]).sum(-1).max()  # farther out a lens may fold back
  count = np.zeros(len(places), int)
  for pose, depth in zip(views.frame_from_camera, views.depth, strict=True):
    nearest = cv2.erode(np.where(np.isfinite(depth), depth, 0), np.ones((3, 3), np.uint8))
    local = (places - pose[:3, 3]) @ pose[:3, :3]
    ahead = np.flatnonzero(local[:, 2] > margin)
    ahead = ahead[np.square(local[ahead, :2] / local[ahead, 2:]).sum(-1) < widest]
    pixels = camera.project(local[ahead])
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    ahead, pixels = ahead[inside], pixels[inside].astype(int)
    count[ahead] += nearest[pixels[:, 1], pixels[:, 0]] - local[ahead, 2] > margin
  return count


def with_thin_things(grid: fusion.Grid, views: fusion.DepthViews) -> fusion.Grid:
  """Returns the grid of depth pictures with matter where they see thin things."""
  at = tuple(thin_voxels(views, grid).T)
  values, weights = grid.values.copy(), grid.weights.copy()
  values[at] = np.minimum(values[at], _VALUE)
  weights[at] = np.maximum(weights[at], np.finfo(np.float32).tiny)  # seen
  return grid._replace(values=values, weights=weights)
