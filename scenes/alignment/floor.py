"""Detects the floor plane: the lowest large plane across the cameras' up direction.

The plane with the most points can be a table top, and the lowest plane a reflection or a few stray
points. So planes are measured by the ground they cover, not by their points, and of those that
cover enough the lowest is taken. Both the search and the choice weigh a plane by how likely its
normal is up as cameras are held (`up.UpBelief`): else they end at slabs through walls, which hold
the more points the more they tilt. Shapes: P points.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.alignment.evidence import Choice, Evidence
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.alignment.planes import across, best_plane, fit_plane
from nerf2real.scenes.alignment.up import UpBelief, by_hand, up_of_cameras

_MIN_POINTS = 30
_PLANES = 12  # candidate planes that are peeled off one after another
_SAME = 0.9  # of the lowest plane's distance from the cameras: 14 cm at 1.4 m
_LEAST = 0.01  # of the points: a plane with fewer is none
_SURE = 3.0  # deviations of the sign test of a plane against what is beside it
UNLIKELY = 3.0  # deviations of a floor's normal from the cameras' up, beyond which it is doubted
_BESIDE = 2.5, 4.5  # tolerances from a plane, on both sides: slabs as thick as its own
_PEEL = 2.5  # tolerances taken off with a plane, or its noise would be the next, lower plane


@dataclasses.dataclass(frozen=True, kw_only=True)
class FloorSettings:
  """Settings of the search for the floor; lengths relative to the median distance of the points."""

  max_tilt_deg: float = 45.0
  """Between the floor's normal and the cameras' up direction, however unsure that is: what is
  steeper is a wall rather than a floor."""
  tolerance: float = 0.012
  """a point this near belongs to a plane: about 2.5 cm in a room."""
  cell: float = 0.05
  """Ground is covered in cells of this size."""
  min_cover: float = 0.25
  """Of the largest plane's cover; smaller planes are furniture."""
  max_points: int = 40_000
  """Subsample for speed."""


class FloorError(ValueError):
  """The points show no floor; the message is one line with what to do."""


class Floor(NamedTuple):
  """A plane normal . x = offset, with the normal up."""

  normal: np.ndarray  # [3]
  offset: float
  points: int  # that lie in it
  cover: float  # ground that its points cover [unit^2]
  residual: float  # root mean square distance of its points [unit]

  def heights(self, points: np.ndarray) -> np.ndarray:
    """Signed heights [...] of points [..., 3] above the floor."""
    return points @ self.normal - self.offset


def _cover(points: np.ndarray, normal: np.ndarray, cell: float) -> float:
  """Ground [unit^2] that points cover, in cells that hold one or more."""
  flat = np.floor(points @ across(normal).T / cell).astype(np.int64)
  return len(np.unique(flat, axis=0)) * cell * cell


def _stands_out(
  points: np.ndarray, normal: np.ndarray, offset: float, *, tolerance: float, cell: float
) -> bool:
  """Whether a plane holds more points than a slab above it and one below, by the number of cells.

  Slabs through a wall or through clutter hold about as many as their neighbours. A cell counts once
  however many points it holds: a sign test.
  """
  heights = (points @ normal - offset) / tolerance
  near = np.abs(heights) < _BESIDE[1]
  heights = heights[near]
  ground = np.floor(points[near] @ across(normal).T / cell).astype(np.int64)
  _, cells = np.unique(ground, axis=0, return_inverse=True)
  inside, above, below = (
    np.bincount(cells.ravel(), weights=held)
    for held in (np.abs(heights) < 1, heights > _BESIDE[0], heights < -_BESIDE[0])
  )
  for beside in (above, below):
    more, fewer = (inside > beside).sum(), (inside < beside).sum()
    if more - fewer < _SURE * np.sqrt(more + fewer):
      return False
  return True


def find_floor(
  points: np.ndarray,
  *,
  up: UpBelief,
  camera_positions: np.ndarray,
  settings: FloorSettings | None = None,
) -> Floor:
  """Finds the floor among sparse points, mesh vertices or lifted depth.

  Args:
    points: Points of the scene [P, 3].
    up: What the cameras show of up.
    camera_positions: Camera centres [N, 3]; the floor lies below nearly all of them.
    settings: Settings.

  Raises:
    FloorError: too few points, or no plane that qualifies.
  """
  settings = settings or FloorSettings()
  points = np.asarray(points, np.float64)
  points = points[np.isfinite(points).all(-1)]
  if len(points) < _MIN_POINTS:
    raise FloorError(
      f"Found {len(points)} points to look for the floor in, need at least {_MIN_POINTS}: film "
      'more of the floor, or give "floor_points" in the override file.'
    )
  if len(points) > settings.max_points:
    chosen = np.random.default_rng(0).permutation(len(points))[: settings.max_points]
    points = points[chosen]
  size = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1)))
  tolerance, cell = settings.tolerance * size, settings.cell * size
  max_tilt = np.radians(settings.max_tilt_deg)

  def prior(normals: np.ndarray) -> np.ndarray:
    return np.where(normals @ up.direction >= np.cos(max_tilt), up.density(normals), 0.0)

  rest, candidates = points, []
  for _ in range(_PLANES):
    if len(rest) < max(_MIN_POINTS // 2, _LEAST * len(points)):
      break
    normal, offset = best_plane(
      rest,
      up.direction,
      tolerance=tolerance,
      max_tilt=max_tilt,
      prior=prior,
      least=_LEAST,
    )
    inside = np.abs(rest @ normal - offset) < tolerance
    below = (camera_positions @ normal - offset > 0).mean()
    if inside.sum() < 10:
      break
    residual = float(np.sqrt(np.mean((rest[inside] @ normal - offset) ** 2)))
    cover = _cover(rest[inside], normal, cell)
    if below > 0.9 and _stands_out(points, normal, offset, tolerance=tolerance, cell=cell):
      candidates.append(Floor(normal, offset, int(inside.sum()), cover, residual))
    rest = rest[np.abs(rest @ normal - offset) > _PEEL * tolerance]
  if not candidates:
    raise FloorError(
      "The pictures show no floor: no level plane below the cameras stands out from what is above "
      "and below it, as where a facade or one thing fills the pictures: film the floor as well, or "
      'give "floor_points" in the override file.'
    )
  covers = [c.cover * float(prior(c.normal)) for c in candidates]
  large = [
    c
    for c, cover in zip(candidates, covers, strict=True)
    if cover >= settings.min_cover * max(covers)
  ]
  centre = camera_positions.mean(0)
  depths = [float(c.heights(centre)) for c in large]
  # What is left of a floor after peeling may pass for a plane of its own: of those near the lowest
  # the one with the most points is the floor.
  lowest = [c for c, depth in zip(large, depths, strict=True) if depth > _SAME * max(depths)]
  return max(lowest, key=lambda c: c.points)


def refine_floor(floor: Floor, points: np.ndarray, *, tolerance: float) -> Floor:
  """Refits a floor to denser points (mesh vertices, lifted depth) within a shrinking distance."""
  points = np.asarray(points, np.float64)
  normal, offset = floor.normal, floor.offset
  for factor in (1.5, 1.0, 0.7, 0.7):
    inside = np.abs(points @ normal - offset) < factor * tolerance
    if inside.sum() < _MIN_POINTS:
      return floor
    normal, offset = fit_plane(points[inside], floor.normal)
  error = points[inside] @ normal - offset
  turned = np.degrees(np.arccos(np.clip(normal @ floor.normal, -1, 1)))
  if turned > 5:  # the dense points near it are no floor
    return floor
  return floor._replace(
    normal=normal,
    offset=offset,
    points=int(inside.sum()),
    residual=float(np.sqrt(np.mean(error**2))),
  )


class FoundFloor(NamedTuple):
  """The floor plane, and whether dense and sparse points give the same."""

  floor: Floor
  dense_trusted: bool  # False where the dense points show a floor that the sparse ones contradict


def cameras_up(evidence: Evidence, override: Overrides) -> UpBelief:
  """What the cameras show of up; the unit frame's up where an override stands in for them."""
  try:
    return up_of_cameras(evidence.frame_from_camera, evidence.up)
  except ValueError:
    if override.up is None and override.floor_points is None:
      raise
    return by_hand(np.array([0.0, 0.0, 1.0]))


def choose_floor(
  evidence: Evidence, override: Overrides, *, settings: FloorSettings, max_gap: float
) -> Choice[FoundFloor]:
  """Finds the floor plane from the override or from dense and sparse points.

  Dense depth shows the textureless floor that sparse points miss; sparse points are right even
  where the field is a fog.

  Args:
    evidence: Points and cameras.
    override: May hold points on the floor, or the up direction.
    settings: Of the search.
    max_gap: Dense above sparse floor, as a share of the cameras' height, from which the dense
      points are not trusted.

  Raises:
    FloorError: No floor was found.
  """
  up = cameras_up(evidence, override) if override.up is None else by_hand(override.up)
  if override.floor_points is not None:
    normal, offset = fit_plane(override.floor_points, up.direction)
    error = override.floor_points @ normal - offset
    floor = Floor(normal, offset, len(error), 0.0, float(np.sqrt(np.mean(error**2))))
    return Choice(FoundFloor(floor, True), "manual_points")
  found = _search(evidence, up, settings, max_gap)
  warnings: tuple[str, ...] = ()
  if not found.dense_trusted:
    warnings = (
      "The field's depth shows no floor, or one well above that of the sparse points or askew: the "
      "field is blurred, and so will be its contact geometry. Train it longer; floor, yaw and "
      "extent are taken from the sparse points.",
    )
  if override.up is None:
    return Choice(found, "plane", warnings)
  floor = found.floor  # a person's up is exact: only the height is searched
  moved = floor.offset + float((up.direction - floor.normal) @ evidence.positions.mean(0))
  exact = floor._replace(normal=up.direction, offset=moved)
  return Choice(found._replace(floor=exact), "manual_up", warnings)


def _search(
  evidence: Evidence, up: UpBelief, settings: FloorSettings, max_gap: float
) -> FoundFloor:
  """Searches the floor in the dense and in the sparse points and compares both."""
  positions = evidence.positions

  def search(cloud: np.ndarray) -> Floor:
    return find_floor(cloud, up=up, camera_positions=positions, settings=settings)

  if evidence.surface_points is None:
    return FoundFloor(search(evidence.points), True)
  try:
    dense = search(_thin(evidence.surface_points))
  except FloorError:
    return FoundFloor(search(evidence.points), False)
  try:
    sparse = search(evidence.points)
  except FloorError:
    return FoundFloor(dense, True)
  centre = positions.mean(0)
  above = 1 - float(dense.heights(centre)) / float(sparse.heights(centre))
  askew = up.deviations(dense.normal) > UNLIKELY >= up.deviations(sparse.normal)
  return FoundFloor(sparse, False) if above >= max_gap or askew else FoundFloor(dense, True)


def _thin(points: np.ndarray) -> np.ndarray:
  """Dense points with equal weight for equal area: close surfaces fill many pixels."""
  size = 0.01 * float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1)))
  _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
  return points[first]
