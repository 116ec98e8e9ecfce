"""Projects 3D Gaussians to 2D Gaussians in a picture (EWA splatting), and the derivatives (numba).

  conic = (J W V V^T W^T J^T + blur I)^-1 with V = R(q) diag(exp(s)), J the projection's Jacobian

Source: Zwicker et al. 2001, EWA volume splatting, equations 24 to 31, as Kerbl et al. 2023 use
them. What is fitted is packed, one row of 14 a splat, all unbounded: offset from the start in units
of the spacing (3), logarithms of the standard deviations [m] (3), quaternion of any length
(w, x, y, z), logit of the opacity, colour (3). Shapes: N splats.
"""

from typing import NamedTuple

import numba
import numpy as np

from nerf2real.core.cameras import Camera

NEAR = 0.05  # nearer splats are not drawn [m]
SLOPE_LIMIT = 1.3  # of the half field of view, where the affine approximation is taken at last
_FLATTEST = 1e-9  # determinant of a 2D covariance [pixel^4]


class Eye(NamedTuple):
  """A pinhole camera at a place."""

  rotation: np.ndarray  # camera from world [3, 3], OpenCV axes
  translation: np.ndarray  # [3] m
  focal: np.ndarray  # fx, fy [pixel]
  centre: np.ndarray  # cx, cy [pixel]
  slope: np.ndarray  # tangents of the half field of view, x and y
  blur: float  # variance added to every 2D Gaussian [pixel^2]

  @classmethod
  def at(cls, camera: Camera, world_from_camera: np.ndarray, *, blur: float) -> "Eye":
    """Returns the eye of a camera without distortion at a pose [4, 4]."""
    rotation = np.ascontiguousarray(world_from_camera[:3, :3].T, np.float64)
    focal = np.array([camera.fx, camera.fy])
    return cls(
      rotation,
      -rotation @ world_from_camera[:3, 3],
      focal,
      np.array([camera.cx, camera.cy]),
      0.5 * np.array([camera.width, camera.height]) / focal,
      blur,
    )


class Projected(NamedTuple):
  """2D Gaussians, or a loss's derivatives by them."""

  centres: np.ndarray  # [N, 2] pixel
  conics: np.ndarray  # inverse covariances: xx, xy, yy [N, 3]
  opacities: np.ndarray  # [N]
  colors: np.ndarray  # [N, 3]


@numba.njit(cache=True)
def _axes(row, rotation, axes):
  """Writes the splat's axes times its deviations, in the camera's frame; returns |q|."""
  w, x, y, z = row[6], row[7], row[8], row[9]
  length = np.sqrt(w * w + x * x + y * y + z * z)
  w, x, y, z = w / length, x / length, y / length, z / length
  for j in range(3):
    a, b, c = rotation[j, 0], rotation[j, 1], rotation[j, 2]
    first = a * (1 - 2 * (y * y + z * z)) + 2 * b * (x * y + w * z) + 2 * c * (x * z - w * y)
    second = 2 * a * (x * y - w * z) + b * (1 - 2 * (x * x + z * z)) + 2 * c * (y * z + w * x)
    third = 2 * a * (x * z + w * y) + 2 * b * (y * z - w * x) + c * (1 - 2 * (x * x + y * y))
    axes[j, 0] = first * np.exp(row[3])
    axes[j, 1] = second * np.exp(row[4])
    axes[j, 2] = third * np.exp(row[5])
  return length


@numba.njit(cache=True)
def _flat(row, start, spacing, eye, axes, flat):
  """Projects one splat: depth, and in `flat` rows of J W V [2, 3], in its last column x/z, y/z."""
  rotation, translation, focal, _, slope, _ = eye
  local = np.empty(3)
  for j in range(3):
    local[j] = translation[j]
    for k in range(3):
      local[j] += rotation[j, k] * (start[k] + spacing * row[k])
  depth = local[2]
  if depth <= NEAR:
    return 0.0
  _axes(row, rotation, axes)
  for j in range(2):
    plane = local[j] / depth
    limit = SLOPE_LIMIT * slope[j]
    bounded = min(max(plane, -limit), limit)
    for k in range(3):
      flat[j, k] = (axes[j, k] - bounded * axes[2, k]) * focal[j] / depth
    flat[j, 3] = plane
  return depth


@numba.njit(cache=True)
def _covariance(flat, blur):
  xx, xy, yy = blur, 0.0, blur
  for k in range(3):
    xx += flat[0, k] * flat[0, k]
    xy += flat[0, k] * flat[1, k]
    yy += flat[1, k] * flat[1, k]
  return xx, xy, yy, max(xx * yy - xy * xy, _FLATTEST)


@numba.njit(cache=True)
def _project(rows, starts, spacing, eye):
  count = len(rows)
  centres, conics = np.zeros((count, 2), np.float32), np.ones((count, 3), np.float32)
  opacities, depths = np.zeros(count, np.float32), np.zeros(count, np.float32)
  axes, flat = np.empty((3, 3)), np.empty((2, 4))
  for n in range(count):
    depths[n] = _flat(rows[n], starts[n], spacing[n], eye, axes, flat)
    if depths[n] == 0:
      continue
    xx, xy, yy, determinant = _covariance(flat, eye[5])
    conics[n, 0], conics[n, 1], conics[n, 2] = yy / determinant, -xy / determinant, xx / determinant
    for j in range(2):
      centres[n, j] = flat[j, 3] * eye[2][j] + eye[3][j]
    opacities[n] = 1 / (1 + np.exp(-rows[n, 10]))
  return centres, conics, opacities, depths


def project(
  rows: np.ndarray, starts: np.ndarray, spacing: np.ndarray, eye: Eye
) -> tuple[Projected, np.ndarray]:
  """Projects splats.

  Args:
    rows: Packed parameters [N, 14].
    starts: Positions that the offsets are from [N, 3] [m].
    spacing: Unit of the offsets [N] [m].
    eye: Where from.

  Returns:
    The 2D Gaussians, and the depths [N] [m]; 0 for splats that are not before the camera.
  """
  centres, conics, opacities, depths = _project(rows, starts, spacing, tuple(eye))
  return Projected(centres, conics, opacities, np.ascontiguousarray(rows[:, 11:])), depths


@numba.njit(cache=True)
def _pull_rotation(row, rotation, by_axes, out):
  """Derivatives by deviations and quaternion, of those by the axes in the camera's frame."""
  g = np.zeros((3, 3))  # by the rotation matrix
  for k in range(3):
    for i in range(3):
      for j in range(3):
        g[i, k] += rotation[j, i] * by_axes[j, k] * np.exp(row[3 + k])
  length = np.sqrt(row[6] ** 2 + row[7] ** 2 + row[8] ** 2 + row[9] ** 2)
  w, x, y, z = row[6] / length, row[7] / length, row[8] / length, row[9] / length
  slopes = (
    x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
    y * (g[0, 1] + g[1, 0])
    + z * (g[0, 2] + g[2, 0])
    + w * (g[2, 1] - g[1, 2])
    - 2 * x * (g[1, 1] + g[2, 2]),
    x * (g[0, 1] + g[1, 0])
    + z * (g[1, 2] + g[2, 1])
    + w * (g[0, 2] - g[2, 0])
    - 2 * y * (g[0, 0] + g[2, 2]),
    x * (g[0, 2] + g[2, 0])
    + y * (g[1, 2] + g[2, 1])
    + w * (g[1, 0] - g[0, 1])
    - 2 * z * (g[0, 0] + g[1, 1]),
  )
  along = w * slopes[0] + x * slopes[1] + y * slopes[2] + z * slopes[3]
  for k, unit in enumerate((w, x, y, z)):
    out[6 + k] = 2 * (slopes[k] - unit * along) / length


@numba.njit(cache=True)
def _pull_plane(flat, by_conic, blur, by_flat):
  """Derivatives by the rows of J W V [2, 3], of those by the conic."""
  xx, xy, yy, determinant = _covariance(flat, blur)
  by_determinant = 0.0
  if determinant > _FLATTEST:
    by_determinant = -(by_conic[0] * yy - by_conic[1] * xy + by_conic[2] * xx) / determinant**2
  by_xx = by_conic[2] / determinant + by_determinant * yy
  by_yy = by_conic[0] / determinant + by_determinant * xx
  by_xy = -by_conic[1] / determinant - 2 * xy * by_determinant
  for k in range(3):
    by_flat[0, k] = 2 * by_xx * flat[0, k] + by_xy * flat[1, k]
    by_flat[1, k] = 2 * by_yy * flat[1, k] + by_xy * flat[0, k]


@numba.njit(cache=True)
def _pull(rows, starts, spacing, eye, by_centre, by_conic, by_opacity, by_color):
  rotation, _, focal, _, slope, blur = eye
  result = np.zeros((len(rows), 14), np.float32)
  axes, flat, by_flat, by_axes = (
    np.empty((3, 3)),
    np.empty((2, 4)),
    np.empty((2, 3)),
    np.empty((3, 3)),
  )
  by_local, out = np.empty(3), np.empty(14)
  for n in range(len(rows)):
    depth = _flat(rows[n], starts[n], spacing[n], eye, axes, flat)
    if depth == 0:
      continue
    _pull_plane(flat, by_conic[n], blur, by_flat)
    by_axes[2] = 0.0
    by_local[2] = 0.0
    for j in range(2):
      plane, limit = flat[j, 3], SLOPE_LIMIT * slope[j]
      bounded = min(max(plane, -limit), limit)
      by_plane, scale = by_centre[n, j] * focal[j], focal[j] / depth
      for k in range(3):
        by_axes[j, k] = by_flat[j, k] * scale
        by_axes[2, k] -= bounded * by_flat[j, k] * scale
        by_local[2] -= by_flat[j, k] * flat[j, k] / depth
        if abs(plane) < limit:
          by_plane -= by_flat[j, k] * axes[2, k] * scale
      by_local[j] = by_plane / depth
      by_local[2] -= by_plane * plane / depth
    for k in range(3):
      out[k] = 0.0
      out[3 + k] = 0.0
      for j in range(3):
        out[k] += spacing[n] * rotation[j, k] * by_local[j]
        out[3 + k] += by_axes[j, k] * axes[j, k]
      out[11 + k] = by_color[n, k]
    _pull_rotation(rows[n], rotation, by_axes, out)
    opacity = 1 / (1 + np.exp(-rows[n, 10]))
    out[10] = by_opacity[n] * opacity * (1 - opacity)
    result[n] = out
  return result


def pull(
  rows: np.ndarray, starts: np.ndarray, spacing: np.ndarray, eye: Eye, slopes: Projected
) -> np.ndarray:
  """Derivatives [N, 14] of a loss by the packed parameters, of those by the 2D Gaussians."""
  gradient: np.ndarray = _pull(rows, starts, spacing, tuple(eye), *slopes)
  return gradient
