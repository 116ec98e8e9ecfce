"""Finds the plane across a rough direction that holds the most points beyond what surrounds it.

All tilts are searched on a grid and all heights by a histogram, as a Hough transform does. Random
triples miss a plane that holds 3 % of the points: one in 40,000 lies in it. A slab counts by how
unlikely its points are beside those of its neighbours: slabs through walls and clutter, which hold
many at every height, count for little. Shapes: P points.
"""

from collections.abc import Callable

import numpy as np

_STEP = np.radians(1.5)  # of the grid of tilts; a slab of twice the tolerance bears it
_SAMPLE = 8_000  # points that vote
_APART = np.radians(3.0)  # between the tilts that are refined
_STARTS = 6  # tilts that are refined
_SLAB = np.repeat([0, 0, 1, 0, 0], 4)  # bins of a tolerance
# as thick on both sides, from 6 to 10 tolerances of its middle: beyond a rough floor's own noise
_BESIDE = np.repeat([0.5, 0, 0, 0, 0.5], 4)
_SHRINKING = (3.0, 2.0, 1.5, 1.0, 1.0, 1.0)  # tolerances of the least-squares fits


def fit_plane(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
  """Least-squares plane through points [P, 3]: unit normal [3] on the side of up, and offset."""
  centre = points.mean(0)
  _, _, vt = np.linalg.svd(points - centre, full_matrices=False)
  normal = vt[2] * (np.sign(vt[2] @ up) or 1.0)
  return normal, float(normal @ centre)


def across(normal: np.ndarray) -> np.ndarray:
  """Two unit vectors [2, 3] that span the plane across a normal."""
  a = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
  a /= np.linalg.norm(a)
  return np.stack([a, np.cross(normal, a)])


def best_plane(
  points: np.ndarray,
  up: np.ndarray,
  *,
  tolerance: float,
  max_tilt: float,
  prior: Callable[[np.ndarray], np.ndarray],
  least: float,
) -> tuple[np.ndarray, float]:
  """The likeliest plane: unit normal [3] and offset (normal . x = offset).

  Args:
    points: Points [P, 3], three or more.
    up: Unit vector [3] that the normal is near.
    tolerance: A point this near belongs to a plane.
    max_tilt: Between normal and up [rad].
    prior: Relative density [...] of normals [..., 3], 1 at most.
    least: Normals of a smaller density are left out.
  """
  steps = np.arange(-np.floor(max_tilt / _STEP), np.floor(max_tilt / _STEP) + 1) * _STEP
  tilts = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
  tilts = tilts[np.linalg.norm(tilts, axis=-1) <= max_tilt]
  normals = up + np.tan(tilts) @ across(up)
  normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
  density = prior(normals)
  normals, density = normals[density >= least], density[density >= least]
  sample = points[:: max(1, len(points) // _SAMPLE)]
  slabs = np.array([_fullest_slab(sample @ normal, tolerance) for normal in normals])
  likelihood, heights = slabs[:, 0] + np.log(density), slabs[:, 1]

  best, found = -np.inf, (normals[0], heights[0])
  refined: list[np.ndarray] = []
  for index in np.argsort(-likelihood, kind="stable"):
    if any(normals[index] @ other > np.cos(_APART) for other in refined):
      continue
    refined.append(normals[index])
    normal, offset = _refined(
      (normals[index], heights[index]), points, up, tolerance, lambda n: bool(prior(n) >= least)
    )
    away = np.abs(sample @ normal - offset) / tolerance
    beside = ((away > 6) & (away < 10)).sum() / 4
    value = float(_evidence((away < 1).sum(), beside) + np.log(prior(normal)))
    if value > best:
      best, found = value, (normal, offset)
    if len(refined) == _STARTS:
      break
  return found


def _evidence(inside: np.ndarray, beside: np.ndarray) -> np.ndarray:
  """Log-likelihood ratio of Poisson counts: n points where m are expected, against n expected.

  n log(n / m) - (n - m), and 0 where n < m.
  """
  n, m = np.maximum(inside, beside) + 1.0, beside + 1.0
  return np.asarray(n * np.log(n / m) - (n - m))


def _fullest_slab(heights: np.ndarray, tolerance: float) -> tuple[float, float]:
  """Evidence of the slab of two tolerances to either side that has the most, and its middle."""
  lowest = heights.min()
  bins = np.bincount(((heights - lowest) / tolerance).astype(np.int64), minlength=4)
  bins = np.pad(bins, 8)
  evidence = _evidence(np.convolve(bins, _SLAB, "valid"), np.convolve(bins, _BESIDE, "valid"))
  fullest = int(evidence.argmax())
  return float(evidence[fullest]), float(lowest + (fullest + 2) * tolerance)


def _refined(
  plane: tuple[np.ndarray, float],
  points: np.ndarray,
  up: np.ndarray,
  tolerance: float,
  allowed: Callable[[np.ndarray], bool],
) -> tuple[np.ndarray, float]:
  for factor in _SHRINKING:
    inside = np.abs(points @ plane[0] - plane[1]) < factor * tolerance
    if inside.sum() < 3:
      break
    fitted = fit_plane(points[inside], up)
    if not allowed(fitted[0]):
      break
    plane = fitted
  return plane
