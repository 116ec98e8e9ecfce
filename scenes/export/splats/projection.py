"""Projects 3D Gaussians to their largest response along a picture's rays (numba), with derivatives.

At an offset q [pixel] from the image of its centre a splat's exponent is at least, along the ray,

  E(q) = |q_x v - q_y u|^2 / (2 |w(q)|^2),  w(q) = u x v + q_x f_y/z^2 (b x c) + q_y f_x/z^2 (c x a)

at the depth z (w(0) . w(q)) / |w(q)|^2. a, b, c are the rows of W R(q) diag(exp(s)) in the camera's
frame, z the centre's depth, u and v the rows of the projection's Jacobian times them. With w(0) in
place of w(q) this is the affine approximation (Zwicker et al. 2001, EWA volume splatting).

Source: Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing, section 4, for the response; the bounds
are those of Sigg et al. 2006, GPU-based ray-casting of quadratic surfaces. What is fitted is
packed, one row of 14 a splat, all unbounded: offset from the start in units of the spacing (3),
logarithms of the standard deviations [m] (3), quaternion of any length (w, x, y, z), logit of the
opacity, colour (3). Shapes: N splats.
"""

from typing import NamedTuple

import numba
import numpy as np

from nerf2real.core.geometry.cameras import Camera

NEAR = 0.05  # nearer splats are not drawn [m]
FAINTEST = 0.01  # alpha below which a splat does not reach a pixel: MuJoCo Warp's
_FLATTEST = 1e-12  # squared area of a projected splat [pixel^4]


class Eye(NamedTuple):
  """A pinhole camera at a place."""

  rotation: np.ndarray  # camera from world [3, 3], OpenCV axes
  translation: np.ndarray  # [3] m
  focal: np.ndarray  # fx, fy [pixel]
  centre: np.ndarray  # cx, cy [pixel]
  slope: np.ndarray  # tangents of the half field of view, x and y

  @classmethod
  def at(cls, camera: Camera, world_from_camera: np.ndarray) -> "Eye":
    """Returns the eye of a camera without distortion at a pose [4, 4]."""
    rotation = np.ascontiguousarray(world_from_camera[:3, :3].T, np.float64)
    focal = np.array([camera.fx, camera.fy])
    return cls(
      rotation,
      -rotation @ world_from_camera[:3, 3],
      focal,
      np.array([camera.cx, camera.cy]),
      0.5 * np.array([camera.width, camera.height]) / focal,
    )


class Projected(NamedTuple):
  """Responses in a picture, or a loss's derivatives by them."""

  centres: np.ndarray  # [N, 2] pixel
  conics: np.ndarray  # of |q_x v - q_y u|^2 / |w(0)|^2: xx, xy, yy [N, 3]
  bends: np.ndarray  # of |w(q)|^2 / |w(0)|^2: halves of x and y, xx, xy, yy [N, 5]
  opacities: np.ndarray  # [N]
  colors: np.ndarray  # [N, 3]


class Bounds(NamedTuple):
  """Where splats are in a picture."""

  depths: np.ndarray  # of the centres [N] [m]; 0 for splats that are not before the camera
  boxes: np.ndarray  # left, right, top, bottom of what is not too faint [N, 4] pixel


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
def _cross(a, b, out):
  out[0] = a[1] * b[2] - a[2] * b[1]
  out[1] = a[2] * b[0] - a[0] * b[2]
  out[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True)
def _dot(a, b):
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True)
def _local(row, start, spacing, eye, local):
  """Writes a splat's centre in the camera's frame; returns its depth, or 0 where it is too near."""
  rotation, translation, _, _, _ = eye
  for j in range(3):
    local[j] = translation[j]
    for k in range(3):
      local[j] += rotation[j, k] * (start[k] + spacing * row[k])
  return local[2] if local[2] > NEAR else 0.0


@numba.njit(cache=True)
def _vectors(local, focal, axes, vectors):
  """Writes u, v, w(0) and the slopes of w along x and y, [5, 3] pixel, pixel^2 and pixel."""
  z = local[2]
  for j in range(2):
    for k in range(3):
      vectors[j, k] = (axes[j, k] - local[j] / z * axes[2, k]) * focal[j] / z
  _cross(vectors[0], vectors[1], vectors[2])
  _cross(axes[1], axes[2], vectors[3])
  _cross(axes[2], axes[0], vectors[4])
  for k in range(3):
    vectors[3, k] *= focal[1] / z**2
    vectors[4, k] *= focal[0] / z**2


@numba.njit(cache=True)
def _forms(vectors, conic, bend):
  """Writes the quadratic forms of a response; returns |w(0)|^2."""
  u, v, w, x, y = vectors
  area = max(_dot(w, w), _FLATTEST)
  conic[0], conic[1], conic[2] = _dot(v, v) / area, -_dot(u, v) / area, _dot(u, u) / area
  bend[0], bend[1] = _dot(w, x) / area, _dot(w, y) / area
  bend[2], bend[3], bend[4] = _dot(x, x) / area, _dot(x, y) / area, _dot(y, y) / area
  return area


@numba.njit(cache=True)
def _box(local, axes, focal, centre, opacity, box):
  """Writes the box of a splat's response; returns whether it has one: all of it lies ahead."""
  reach = 2 * np.log(max(opacity / FAINTEST, 1.0))
  ahead = local[2] ** 2 - reach * _dot(axes[2], axes[2])
  if ahead <= NEAR**2:
    return False
  for j in range(2):
    side = local[j] ** 2 - reach * _dot(axes[j], axes[j])
    middle = local[j] * local[2] - reach * _dot(axes[j], axes[2])
    half = np.sqrt(max(middle**2 - side * ahead, 0.0))
    box[2 * j] = (middle - half) / ahead * focal[j] + centre[j]
    box[2 * j + 1] = (middle + half) / ahead * focal[j] + centre[j]
  return True


@numba.njit(cache=True)
def _project(rows, starts, spacing, eye):
  rotation, _, focal, centre, _ = eye
  count = len(rows)
  centres, conics = np.zeros((count, 2), np.float32), np.ones((count, 3), np.float32)
  bends, boxes = np.zeros((count, 5), np.float32), np.zeros((count, 4), np.float32)
  opacities, depths = np.zeros(count, np.float32), np.zeros(count, np.float32)
  local, axes, vectors = np.empty(3), np.empty((3, 3)), np.empty((5, 3))
  for n in range(count):
    opacities[n] = 1 / (1 + np.exp(-rows[n, 10]))
    depth = _local(rows[n], starts[n], spacing[n], eye, local)
    if depth == 0:
      continue
    _axes(rows[n], rotation, axes)
    if not _box(local, axes, focal, centre, opacities[n], boxes[n]):
      continue
    depths[n] = depth
    _vectors(local, focal, axes, vectors)
    _forms(vectors, conics[n], bends[n])
    for j in range(2):
      centres[n, j] = local[j] / depth * focal[j] + centre[j]
  return centres, conics, bends, opacities, depths, boxes


def project(
  rows: np.ndarray, starts: np.ndarray, spacing: np.ndarray, eye: Eye
) -> tuple[Projected, Bounds]:
  """Projects splats.

  Args:
    rows: Packed parameters [N, 14].
    starts: Positions that the offsets are from [N, 3] [m].
    spacing: Unit of the offsets [N] [m].
    eye: Where from.
  """
  found = _project(rows, starts, spacing, tuple(eye))
  centres, conics, bends, opacities, depths, boxes = found
  colors = np.ascontiguousarray(rows[:, 11:])
  return Projected(centres, conics, bends, opacities, colors), Bounds(depths, boxes)


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
def _pull_forms(vectors, conic, bend, area, by_conic, by_bend, by_vectors):
  """Derivatives by the vectors [5, 3], of those by the quadratic forms."""
  u, v, w, x, y = vectors
  by_area = 0.0
  if area > _FLATTEST:
    for k in range(3):
      by_area -= by_conic[k] * conic[k] / area
    for k in range(5):
      by_area -= by_bend[k] * bend[k] / area
  for k in range(3):
    by_vectors[0, k] = (2 * by_conic[2] * u[k] - by_conic[1] * v[k]) / area
    by_vectors[1, k] = (2 * by_conic[0] * v[k] - by_conic[1] * u[k]) / area
    by_vectors[2, k] = 2 * by_area * w[k] + (by_bend[0] * x[k] + by_bend[1] * y[k]) / area
    by_vectors[3, k] = (by_bend[0] * w[k] + 2 * by_bend[2] * x[k] + by_bend[3] * y[k]) / area
    by_vectors[4, k] = (by_bend[1] * w[k] + by_bend[3] * x[k] + 2 * by_bend[4] * y[k]) / area


@numba.njit(cache=True)
def _pull_cross(a, b, by_product, factor, by_a, by_b, out):
  """Adds the derivatives by a and b, of those by factor (a x b)."""
  _cross(b, by_product, out)
  for k in range(3):
    by_a[k] += factor * out[k]
  _cross(by_product, a, out)
  for k in range(3):
    by_b[k] += factor * out[k]


@numba.njit(cache=True)
def _pull_vectors(local, focal, axes, vectors, by_vectors, by_axes, by_local):
  """Adds the derivatives by axes and centre, of those by the vectors."""
  z, out = local[2], np.empty(3)
  _pull_cross(vectors[0], vectors[1], by_vectors[2], 1.0, by_vectors[0], by_vectors[1], out)
  _pull_cross(axes[1], axes[2], by_vectors[3], focal[1] / z**2, by_axes[1], by_axes[2], out)
  _pull_cross(axes[2], axes[0], by_vectors[4], focal[0] / z**2, by_axes[2], by_axes[0], out)
  by_local[2] -= 2 / z * (_dot(by_vectors[3], vectors[3]) + _dot(by_vectors[4], vectors[4]))
  for j in range(2):
    plane, scale = local[j] / z, focal[j] / z
    by_plane = -scale * _dot(by_vectors[j], axes[2])
    by_local[j] += by_plane / z
    by_local[2] -= (by_plane * plane + _dot(by_vectors[j], vectors[j])) / z
    for k in range(3):
      by_axes[j, k] += by_vectors[j, k] * scale
      by_axes[2, k] -= by_vectors[j, k] * scale * plane


@numba.njit(cache=True)
def _pull(rows, starts, spacing, eye, by_centre, by_conic, by_bend, by_opacity, by_color):
  rotation, _, focal, centre, _ = eye
  result = np.zeros((len(rows), 14), np.float32)
  axes, by_axes, local, by_local = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
  vectors, by_vectors, out = np.empty((5, 3)), np.empty((5, 3)), np.empty(14)
  conic, bend, box = np.empty(3), np.empty(5), np.empty(4)
  for n in range(len(rows)):
    depth, opacity = (
      _local(rows[n], starts[n], spacing[n], eye, local),
      1 / (1 + np.exp(-rows[n, 10])),
    )
    if depth == 0:
      continue
    _axes(rows[n], rotation, axes)
    if not _box(local, axes, focal, centre, opacity, box):
      continue
    _vectors(local, focal, axes, vectors)
    area = _forms(vectors, conic, bend)
    _pull_forms(vectors, conic, bend, area, by_conic[n], by_bend[n], by_vectors)
    by_axes[:] = 0.0
    by_local[2] = 0.0
    for j in range(2):
      by_local[j] = by_centre[n, j] * focal[j] / depth
      by_local[2] -= by_local[j] * local[j] / depth
    _pull_vectors(local, focal, axes, vectors, by_vectors, by_axes, by_local)
    for k in range(3):
      out[k] = 0.0
      out[3 + k] = 0.0
      for j in range(3):
        out[k] += spacing[n] * rotation[j, k] * by_local[j]
        out[3 + k] += by_axes[j, k] * axes[j, k]
      out[11 + k] = by_color[n, k]
    _pull_rotation(rows[n], rotation, by_axes, out)
    out[10] = by_opacity[n] * opacity * (1 - opacity)
    result[n] = out
  return result


def pull(
  rows: np.ndarray, starts: np.ndarray, spacing: np.ndarray, eye: Eye, slopes: Projected
) -> np.ndarray:
  """Derivatives [N, 14] of a loss by the packed parameters, of those by the responses."""
  gradient: np.ndarray = _pull(rows, starts, spacing, tuple(eye), *slopes)
  return gradient
