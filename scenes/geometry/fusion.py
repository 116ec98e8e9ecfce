"""Fuses depth pictures into a signed distance grid: the source of every surface.

Thresholding the field's density keeps floaters and invents matter where no camera ever looked.
Here a voxel is free because rays passed through it, solid because it lies just behind a seen
surface, and unknown otherwise. Shapes: N views, H height, W width, X, Y, Z voxels.
"""

import dataclasses
from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import ArrayLike

from nerf2real.core.geometry import cameras, similarity
from nerf2real.core.progress import Progress, no_progress

_MIN_COSINE = 0.15  # steepest incidence that still counts: at 81 degrees depth is mostly noise
EDGE = 0.08  # a pixel whose neighbour is this much deeper (relative) sits on a silhouette
_MAX_VOXELS = 60_000_000  # 0.5 GB of values and weights


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthViews:
  """Depth pictures with their poses, all in one frame and one unit of length."""

  camera: cameras.Camera
  """Of the depth pictures; its size is theirs."""
  frame_from_camera: np.ndarray
  """float64 [N, 4, 4], OpenCV camera axes."""
  depth: np.ndarray
  """float32 [N, H, W], z-depth; inf or nan: nothing was hit."""
  color: np.ndarray | None = None
  """uint8 [N, H, W, 3]."""

  def __post_init__(self):
    expected = (len(self.frame_from_camera), self.camera.height, self.camera.width)
    if self.depth.shape != expected:
      raise ValueError(
        f"Depth pictures have shape {self.depth.shape}, poses and camera ask for {expected}: "
        "render them with this camera at these poses."
      )
    if self.color is not None and self.color.shape != (*expected, 3):
      raise ValueError(f"Color pictures have shape {self.color.shape}, expected {(*expected, 3)}.")

  @property
  def positions(self) -> np.ndarray:
    """Camera centres [N, 3]."""
    return self.frame_from_camera[:, :3, 3]

  def transformed(self, transform: similarity.Similarity) -> "DepthViews":
    """Returns the same pictures in another frame; depth takes the scale."""
    return dataclasses.replace(
      self,
      frame_from_camera=transform.apply_pose(self.frame_from_camera),
      depth=(self.depth * transform.scale).astype(np.float32),
    )

  def surface_points(self, *, stride: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Lifts pixels to surface points and normals.

    Args:
      stride: Every stride-th pixel of both axes is used.

    Returns:
      Points [P, 3] and unit normals [P, 3] towards the camera; silhouettes are left out.
    """
    rays = self.camera.rays()
    points, normals = [], []
    for pose, depth in zip(self.frame_from_camera, self.depth, strict=True):
      depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
      local = rays * depth[..., None]
      normal, cosine = pixel_normals(depth, rays)
      keep = (cosine > _MIN_COSINE) & (depth > 0)
      grid = np.zeros_like(keep)
      grid[::stride, ::stride] = True
      keep &= grid
      points.append(local[keep] @ pose[:3, :3].T + pose[:3, 3])
      normals.append(normal[keep] @ pose[:3, :3].T)
    return np.concatenate(points), np.concatenate(normals)


class Grid(NamedTuple):
  """A signed distance grid: negative inside matter, +1 far in front, in units of the truncation."""

  values: np.ndarray  # float32 [X, Y, Z] in [-1, 1]; +1 where unknown
  weights: np.ndarray  # float32 [X, Y, Z]; 0: seen by no ray
  lower: np.ndarray  # [3] centre of voxel (0, 0, 0)
  voxel: float  # edge of a voxel
  truncation: float  # distance that the value 1 stands for

  @property
  def observed(self) -> np.ndarray:
    """Voxels that a ray passed through or ended in, bool [X, Y, Z]."""
    return self.weights > 0

  @property
  def solid(self) -> np.ndarray:
    """Voxels behind a seen surface, bool [X, Y, Z]."""
    return (self.values < 0) & (self.weights > 0)

  def centres(self, axis: int) -> np.ndarray:
    """Coordinates of the voxel centres along an axis."""
    return self.lower[axis] + self.voxel * np.arange(self.values.shape[axis])


def pixel_normals(depth: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Normals of a depth picture [H, W] with rays [H, W, 3], by central differences.

  The differences are taken on a 5x5 median and smoothed, or the noise of single pixels would tilt
  them: between pixels 2 cm apart a noise of 1 cm turns a normal by 30 degrees.

  Returns:
    Unit normals towards the camera [H, W, 3] and the cosine of incidence [H, W]; the cosine is 0 on
    silhouettes, where depth is missing, and along the border.
  """
  smooth: np.ndarray = cv2.blur(cv2.medianBlur(depth, 5), (3, 3))
  local = rays * smooth[..., None]
  normal = np.zeros_like(local)
  right, down = local[1:-1, 2:] - local[1:-1, :-2], local[2:, 1:-1] - local[:-2, 1:-1]
  normal[1:-1, 1:-1] = np.cross(down, right)
  length = np.linalg.norm(normal, axis=-1)
  normal /= np.maximum(length, 1e-12)[..., None]
  direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
  cosine = -(normal * direction).sum(-1)
  near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
  # What a plane seen at this slant would show as relief within 3x3 pixels is no silhouette.
  angle = np.abs(rays[1:-1, 2:, 0] - rays[1:-1, :-2, 0]).mean() / 2
  relief = EDGE + 2 * angle * np.sqrt(1 / np.maximum(cosine, _MIN_COSINE) ** 2 - 1)
  bad = (near <= 0) | (far - near > relief * near) | (length < 1e-12)
  bad[[0, -1], :] = bad[:, [0, -1]] = True
  return normal, np.where(bad, 0, cosine)


@numba.njit(parallel=True, cache=True, fastmath=True)
def _fuse(
  lower, voxel, truncation, inverse_poses, lens, limit, depth, nearest, cosine, values, weights
):
  sx, sy, sz = values.shape
  count, height, width = depth.shape
  fx, fy, cx, cy, k1, k2, p1, p2 = lens
  for i in numba.prange(sx):
    for n in range(count):
      pose = inverse_poses[n]
      x0 = lower[0] + voxel * i
      for j in range(sy):
        y0 = lower[1] + voxel * j
        ax = pose[0, 0] * x0 + pose[0, 1] * y0 + pose[0, 2] * lower[2] + pose[0, 3]
        ay = pose[1, 0] * x0 + pose[1, 1] * y0 + pose[1, 2] * lower[2] + pose[1, 3]
        az = pose[2, 0] * x0 + pose[2, 1] * y0 + pose[2, 2] * lower[2] + pose[2, 3]
        for k in range(sz):
          step = voxel * k
          z = az + pose[2, 2] * step
          if z <= 1e-3 * truncation:
            continue
          x = (ax + pose[0, 2] * step) / z
          y = (ay + pose[1, 2] * step) / z
          rr = x * x + y * y
          if rr > limit:
            continue
          radial = 1 + k1 * rr + k2 * rr * rr
          u = fx * (x * radial + 2 * p1 * x * y + p2 * (rr + 2 * x * x)) + cx
          v = fy * (y * radial + p1 * (rr + 2 * y * y) + 2 * p2 * x * y) + cy
          if u < 0 or v < 0 or u >= width or v >= height:
            continue
          column, row = int(u), int(v)
          d = depth[n, row, column]
          if d <= 0:
            continue
          slant = cosine[n, row, column]
          ahead = (d - z) * np.sqrt(1 + rr)
          if slant > _MIN_COSINE:  # the distance to the tangent plane of the pixel's surface
            signed = ahead * slant
            weight = slant / (d * d)
          else:
            signed = ahead
            weight = _MIN_COSINE / (d * d)
            if signed < truncation:  # a silhouette's depth is a guess: it may only free space
              continue
          if signed < -truncation:
            continue
          if signed > truncation:
            signed = truncation
            if (nearest[n, row, column] - z) * np.sqrt(1 + rr) < truncation:
              continue
          elif signed < 0:  # less trust the further behind: the far side of thin things
            weight *= 1 + 0.9 * signed / truncation
          values[i, j, k] += weight * signed
          weights[i, j, k] += weight


def grid_shape(lower: ArrayLike, upper: ArrayLike, voxel: float) -> np.ndarray:
  """Returns the shape [3] of the grid over a box; raises ValueError where it is too large.

  Args:
    lower: Lower corner of the box [3].
    upper: Upper corner [3].
    voxel: Edge of a voxel.
  """
  lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
  shape = np.maximum(np.ceil((upper - lower) / voxel).astype(int), 1) + 1
  if np.prod(shape, dtype=np.float64) > _MAX_VOXELS:
    raise ValueError(
      f"A box of {np.round(upper - lower, 3)} at voxels of {voxel:.4g} has {shape} voxels, more "
      f"than {_MAX_VOXELS}: crop the extent or take larger voxels."
    )
  return shape


def fuse(
  views: DepthViews,
  *,
  lower: np.ndarray,
  upper: np.ndarray,
  voxel: float,
  truncation: float | None = None,
  progress: Progress = no_progress,
) -> Grid:
  """Averages truncated signed distances of all views over a box.

  A pixel's surface is taken as a plane with the depth picture's own normal; the weight is the
  cosine of incidence over the squared depth.

  Args:
    views: Depth pictures in the frame of the box.
    lower: Lower corner of the box [3].
    upper: Upper corner of the box [3].
    voxel: Edge of a voxel.
    truncation: Band around a surface in which distances are averaged; 3 voxels if None.
    progress: Called with the fraction done and a text.

  Source: Curless and Levoy 1996, A volumetric method for building complex models from range images,
  section 3; the tangent planes are an addition.
  """
  lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
  shape = grid_shape(lower, upper, voxel)
  truncation = 3 * voxel if truncation is None else truncation
  depth = np.where(np.isfinite(views.depth), views.depth, 0).astype(np.float32)
  rays = views.camera.rays()
  nearest, cosine = np.empty_like(depth), np.empty_like(depth)
  for n, picture in enumerate(depth):
    nearest[n] = cv2.erode(
      np.where(picture > 0, picture, np.inf).astype(np.float32), np.ones((3, 3))
    )
    _, cosine[n] = pixel_normals(picture, rays)
  limit = float(1.05 * (rays[..., :2] ** 2).sum(-1).max())
  inverse = np.linalg.inv(views.frame_from_camera).astype(np.float32)
  values, weights = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
  batch = 16
  for start in range(0, len(depth), batch):
    part = slice(start, start + batch)
    _fuse(
      lower.astype(np.float32),
      np.float32(voxel),
      np.float32(truncation),
      inverse[part],
      views.camera.lens,
      limit,
      depth[part],
      nearest[part],
      cosine[part],
      values,
      weights,
    )
    progress(min(1.0, (start + batch) / len(depth)), "fusing depth")
  seen = weights > 0
  np.divide(values, weights * truncation, out=values, where=seen)
  values[~seen] = 1.0
  return Grid(values, weights, lower, float(voxel), float(truncation))
