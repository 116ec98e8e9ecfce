"""Finds where pictures show the floor behind a surface that the field has put before it.

On a plain or blurred floor the field's depth may stand decimetres too high, and the contact
geometry then has matter where a robot should walk. Two hypotheses are compared for such a pixel:
its surface is where the field's depth is, or it is the floor. Under each, the patch around the
pixel has its place in other pictures; the one under which the patches correlate is true. What all
views find is averaged in space.
Source of the comparison: Collins 1996, "A space-sweep approach to true multi-image matching", with
two surfaces in place of a sweep. Shapes: N views, H height, W width.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numba
import numpy as np
from scipy import ndimage

from nerf2real.core.geometry.cameras import PIXEL_CENTRE
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import fusion

_REACH = 4  # pixels of a patch to each side: 7 to 11 cm at 2 m in a picture of 320; chosen
_STEP = 2  # pixels between patches
_CONTRAST = 2.0  # grey levels; a patch with less deviation says nothing
_ALIKE = 0.5  # least mean correlation of what is taken for the floor: that of noise is 0
_NEAREST, _EVERY = 24, 3  # every third of the nearest views that look the same way is compared
_SAME_WAY = 0.7  # cosine of the angle between optical axes
_BASELINE = 0.1  # m between two cameras; less moves 5 cm of height at 2 m by a third of a pixel
_SAME = 0.1  # m by which another view's surface may differ where it sees the same
_LOWEST = 0.02  # m: lower surface is floor already
_CELL = 0.05  # m, edge of the cells that gather what the views find
_SPREAD = 2.0  # cells, deviation of the Gaussian that joins textured patches; chosen: with 1, 0.2 %
# of what was moved in a room of known truth had been true, with 2 none
_FEWEST = 3.0  # comparisons in and around a cell that decides
_FRONT = 0.2  # least cosine of a ray to the floor with its normal


@numba.njit(cache=True)
def _patch(image, rays, pose, row, column, depth, is_floor, other, inverse, lens):
  """Correlation of the patch around a pixel with another picture; -2 where it leaves the picture.

  Args:
    image: The picture [H, W].
    rays: Its pixels' rays [H, W, 3], z = 1.
    pose: World from camera [4, 4].
    row, column: The pixel.
    depth: Depth of the patch's pixels [H, W].
    is_floor: Whether to place them on the floor instead.
    other: The other picture [H, W].
    inverse: Its camera from world [4, 4].
    lens: fx, fy, cx, cy, k1, k2, p1, p2.
  """
  fx, fy, cx, cy, k1, k2, p1, p2 = lens
  height, width = other.shape
  n, sa, sb, saa, sbb, sab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
  for i in range(row - _REACH, row + _REACH + 1):
    for j in range(column - _REACH, column + _REACH + 1):
      ray = rays[i, j]
      dx = pose[0, 0] * ray[0] + pose[0, 1] * ray[1] + pose[0, 2] * ray[2]
      dy = pose[1, 0] * ray[0] + pose[1, 1] * ray[1] + pose[1, 2] * ray[2]
      dz = pose[2, 0] * ray[0] + pose[2, 1] * ray[1] + pose[2, 2] * ray[2]
      reach = -pose[2, 3] / dz if is_floor else depth[i, j]
      if not (reach > 0 and reach < 1e3):
        return -2.0
      px, py, pz = pose[0, 3] + reach * dx, pose[1, 3] + reach * dy, pose[2, 3] + reach * dz
      z = inverse[2, 0] * px + inverse[2, 1] * py + inverse[2, 2] * pz + inverse[2, 3]
      if z < 0.1:
        return -2.0
      x = (inverse[0, 0] * px + inverse[0, 1] * py + inverse[0, 2] * pz + inverse[0, 3]) / z
      y = (inverse[1, 0] * px + inverse[1, 1] * py + inverse[1, 2] * pz + inverse[1, 3]) / z
      rr = x * x + y * y
      radial = 1 + k1 * rr + k2 * rr * rr
      u = fx * (x * radial + 2 * p1 * x * y + p2 * (rr + 2 * x * x)) + cx - PIXEL_CENTRE
      v = fy * (y * radial + p1 * (rr + 2 * y * y) + 2 * p2 * x * y) + cy - PIXEL_CENTRE
      if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1 and rr < 2.0):
        return -2.0
      c, r = int(u), int(v)
      a, b = u - c, v - r
      value = (1 - b) * ((1 - a) * other[r, c] + a * other[r, c + 1])
      value += b * ((1 - a) * other[r + 1, c] + a * other[r + 1, c + 1])
      own = image[i, j]
      n += 1
      sa += own
      sb += value
      saa += own * own
      sbb += value * value
      sab += own * value
  va, vb = saa / n - (sa / n) ** 2, sbb / n - (sb / n) ** 2
  if va < _CONTRAST**2:
    return -2.0
  return (sab / n - sa * sb / n**2) / np.sqrt(va * max(vb, _CONTRAST**2))


@numba.njit(cache=True)
def _sees(x, y, z, inverse, lens, depth):
  """Whether a view's surface lies at a point."""
  fx, fy, cx, cy, k1, k2, p1, p2 = lens
  height, width = depth.shape
  pz = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z + inverse[2, 3]
  if pz < 0.1:
    return False
  px = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2] * z + inverse[0, 3]) / pz
  py = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2] * z + inverse[1, 3]) / pz
  rr = px * px + py * py
  radial = 1 + k1 * rr + k2 * rr * rr
  u = fx * (px * radial + 2 * p1 * px * py + p2 * (rr + 2 * px * px)) + cx
  v = fy * (py * radial + p1 * (rr + 2 * py * py) + 2 * p2 * px * py) + cy
  if not (u >= 0 and v >= 0 and u < width and v < height and rr < 2.0):
    return False
  return abs(depth[int(v), int(u)] - pz) < _SAME


@numba.njit(parallel=True, cache=True)
def _compare(index, others, images, depth, rays, poses, inverses, lens, found):
  """Compares both hypotheses for every `_STEP`th pixel of a view with other views.

  Writes rows (x, y, z, sum of the surface's correlations, of the floor's, comparisons) into
  found [H, W, 6]; 0 comparisons where there is nothing to say.
  """
  height, width = depth.shape[1:]
  pose = poses[index]
  rows = (height - 2 * _REACH + _STEP - 1) // _STEP
  for step in numba.prange(rows):
    i = _REACH + _STEP * step
    for j in range(_REACH, width - _REACH, _STEP):
      d = depth[index, i, j]
      ray = rays[i, j]
      dx = pose[0, 0] * ray[0] + pose[0, 1] * ray[1] + pose[0, 2] * ray[2]
      dy = pose[1, 0] * ray[0] + pose[1, 1] * ray[1] + pose[1, 2] * ray[2]
      dz = pose[2, 0] * ray[0] + pose[2, 1] * ray[1] + pose[2, 2] * ray[2]
      x, y, z = pose[0, 3] + d * dx, pose[1, 3] + d * dy, pose[2, 3] + d * dz
      if not (d > 0 and z > _LOWEST and dz < -_FRONT * np.sqrt(dx * dx + dy * dy + dz * dz)):
        continue
      count, surface, floor = 0, 0.0, 0.0
      for k in others:
        if not _sees(x, y, z, inverses[k], lens, depth[k]):
          continue
        a = _patch(
          images[index], rays, pose, i, j, depth[index], False, images[k], inverses[k], lens
        )
        if a < -1.5:
          continue
        b = _patch(
          images[index], rays, pose, i, j, depth[index], True, images[k], inverses[k], lens
        )
        if b < -1.5:
          continue
        count, surface, floor = count + 1, surface + a, floor + b
      if count:
        found[i, j, 0], found[i, j, 1], found[i, j, 2] = x, y, z
        found[i, j, 3], found[i, j, 4], found[i, j, 5] = surface, floor, count


def _others(number: int, poses: np.ndarray, chosen: np.ndarray) -> np.ndarray:
  """Views that the chosen view of a number is compared with: those that look the same way."""
  own, others = poses[chosen[number]], poses[chosen]
  baseline = np.linalg.norm(others[:, :3, 3] - own[:3, 3], axis=-1)
  alike = (others[:, :3, 2] @ own[:3, 2] > _SAME_WAY) & (baseline > _BASELINE)
  nearest = np.flatnonzero(alike)[np.argsort(baseline[alike])]
  found: np.ndarray = chosen[nearest[:_NEAREST:_EVERY]]
  return found


def with_seen_floor(
  views: fusion.DepthViews,
  pictures: np.ndarray,
  chosen: Sequence[int] | np.ndarray,
  *,
  lower: np.ndarray,
  upper: np.ndarray,
  progress: Progress = no_progress,
) -> fusion.DepthViews:
  """Returns depth pictures whose surface is the floor where pictures show the floor.

  Args:
    views: Depth pictures in the world frame (metres, floor at z = 0).
    pictures: Grey pictures of the same size and of one exposure, uint8 or float32 [N, H, W].
    chosen: Views whose pictures are looked at; the depth of all is corrected.
    lower: Lower corner of the extent [3].
    upper: Upper corner [3].
    progress: Called with the fraction done and a text.
  """
  lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
  rays = views.camera.rays()
  depth = np.where(np.isfinite(views.depth), views.depth, 0).astype(np.float32)
  sums = np.zeros((3, *(np.ceil((upper - lower) / _CELL).astype(int) + 1)))
  for rows in _compared(views, depth, rays, pictures, np.sort(chosen), progress):
    cells = np.round((rows[:, :3] - lower) / _CELL).astype(int)
    inside = ((cells >= 0) & (cells < sums.shape[1:])).all(-1)
    for total, value in zip(sums, rows[inside, 3:].T, strict=True):
      np.add.at(total, tuple(cells[inside].T), value)
  surface, floor, count = (ndimage.gaussian_filter(total, _SPREAD) for total in sums)
  wrong = count * (2 * np.pi * _SPREAD**2) ** 1.5 >= _FEWEST
  wrong &= (floor > surface) & (floor > _ALIKE * count)
  return dataclasses.replace(views, depth=_on_floor(views, depth, rays, lower, wrong))


def _compared(
  views: fusion.DepthViews,
  depth: np.ndarray,
  rays: np.ndarray,
  pictures: np.ndarray,
  chosen: np.ndarray,
  progress: Progress,
) -> Iterator[np.ndarray]:
  """Yields what `_compare` finds in each chosen view, rows [K, 6] with comparisons."""
  poses = np.asarray(views.frame_from_camera, np.float64)
  inverses = np.linalg.inv(poses)
  images = np.ascontiguousarray(pictures, np.float32)
  found = np.zeros((*depth.shape[1:], 6))
  for number, index in enumerate(chosen):
    others = _others(number, poses, chosen)
    if len(others):
      found[...] = 0
      _compare(index, others, images, depth, rays, poses, inverses, views.camera.lens, found)
      yield found[found[..., 5] > 0]
    progress((number + 1) / len(chosen), "floor behind wrong surfaces")


def _on_floor(
  views: fusion.DepthViews,
  depth: np.ndarray,
  rays: np.ndarray,
  lower: np.ndarray,
  wrong: np.ndarray,
) -> np.ndarray:
  """Depth pictures whose surface in wrong cells bool [X, Y, Z] is moved to the floor."""
  result = views.depth.copy()
  for index, pose in enumerate(views.frame_from_camera):
    ways = rays @ pose[:3, :3].T
    points = ways * depth[index][..., None] + pose[:3, 3]
    cells = np.round((points - lower) / _CELL).astype(int)
    inside = ((cells >= 0) & (cells < wrong.shape)).all(-1) & (depth[index] > 0)
    inside &= ways[..., 2] < -_FRONT * np.linalg.norm(ways, axis=-1)
    cells = np.where(inside[..., None], cells, 0)
    moved = inside & wrong[tuple(np.moveaxis(cells, -1, 0))] & (points[..., 2] > _LOWEST)
    result[index][moved] = (-pose[2, 3] / ways[..., 2])[moved]
  return result
