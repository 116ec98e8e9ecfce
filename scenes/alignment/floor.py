"""Detects the floor plane: the lowest large plane across the cameras' up direction.

The plane with the most points can be a table top, and the lowest plane a reflection or a few stray
points. So planes are measured by the ground they cover, not by their points, and of those that
cover enough the lowest is taken. Shapes: P points.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from nerf2real.core import rotations
from nerf2real.scenes.alignment.evidence import Choice, Evidence
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.alignment.planes import across, best_plane, fit_plane

_MIN_POINTS = 30
_PLANES = 12  # candidate planes that are peeled off one after another
_SAME = 0.9  # of the lowest plane's distance from the cameras: 14 cm at 1.4 m
_PEEL = 2.5  # tolerances taken off with a plane, or its noise would be the next, lower plane


@dataclasses.dataclass(frozen=True, kw_only=True)
class FloorSettings:
  """Settings of the search for the floor; lengths relative to the median distance of the points."""

  max_tilt_deg: float = 20.0
  """Between the floor's normal and the cameras' up direction."""
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
  tilt_from_cameras_deg: float  # angle to the cameras' up direction

  def heights(self, points: np.ndarray) -> np.ndarray:
    """Signed heights [...] of points [..., 3] above the floor."""
    return points @ self.normal - self.offset


def mean_up(frame_from_camera: np.ndarray) -> np.ndarray:
  """The cameras' up direction [3]: a phone is held upright, see `rotations.level_up`."""
  up = -frame_from_camera[:, :3, 1].mean(0)
  length = np.linalg.norm(up)
  if length < 0.2:
    raise ValueError(
      f"The cameras' up directions cancel (mean length {length:.2f}): the pictures are rolled all "
      'ways. Give "up" or "floor_points" in the override file.'
    )
  return rotations.level_up(frame_from_camera, up)


def _cover(points: np.ndarray, normal: np.ndarray, cell: float) -> float:
  """Ground [unit^2] that points cover, in cells that hold one or more."""
  flat = np.floor(points @ across(normal).T / cell).astype(np.int64)
  return len(np.unique(flat, axis=0)) * cell * cell


def find_floor(
  points: np.ndarray,
  *,
  up: np.ndarray,
  camera_positions: np.ndarray,
  settings: FloorSettings | None = None,
) -> Floor:
  """Finds the floor among sparse points, mesh vertices or lifted depth.

  Args:
    points: Points of the scene [P, 3].
    up: Rough up direction [3].
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
  up = np.asarray(up, np.float64) / np.linalg.norm(up)
  size = float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1)))
  tolerance, cell = settings.tolerance * size, settings.cell * size
  rest, candidates = points, []
  for _ in range(_PLANES):
    if len(rest) < max(_MIN_POINTS // 2, 0.01 * len(points)):
      break
    normal, offset = best_plane(
      rest, up, tolerance=tolerance, max_tilt=np.radians(settings.max_tilt_deg)
    )
    inside = np.abs(rest @ normal - offset) < tolerance
    below = (camera_positions @ normal - offset > 0).mean()
    if inside.sum() < 10:
      break
    residual = float(np.sqrt(np.mean((rest[inside] @ normal - offset) ** 2)))
    tilt = np.degrees(np.arccos(np.clip(normal @ up, -1, 1)))
    floor = Floor(
      normal, offset, int(inside.sum()), _cover(rest[inside], normal, cell), residual, float(tilt)
    )
    if below > 0.9:
      candidates.append(floor)
    rest = rest[np.abs(rest @ normal - offset) > _PEEL * tolerance]
  if not candidates:
    raise FloorError(
      f"No plane within {settings.max_tilt_deg:g} degrees of the cameras' up direction lies below "
      'the cameras: film the floor, or give "floor_points" in the override file.'
    )
  largest = max(c.cover for c in candidates)
  large = [c for c in candidates if c.cover >= settings.min_cover * largest]
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
  dense_trusted: bool  # False where the dense points show a floor well above the sparse ones'


def rough_up(evidence: Evidence, override: Overrides) -> np.ndarray:
  """The cameras' up direction [3]; the unit frame's where only the override has one."""
  if evidence.up is not None:
    return evidence.up
  try:
    return mean_up(evidence.frame_from_camera)
  except ValueError:
    if override.up is None and override.floor_points is None:
      raise
    return np.array([0.0, 0.0, 1.0])


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
  camera_up = rough_up(evidence, override)
  if override.floor_points is not None:
    normal, offset = fit_plane(override.floor_points, camera_up)
    error = override.floor_points @ normal - offset
    floor = Floor(normal, offset, len(error), 0.0, float(np.sqrt(np.mean(error**2))), 0.0)
    return Choice(FoundFloor(floor, True), "manual_points")
  up, source = camera_up, "plane"
  if override.up is not None:  # a person's up is exact: only the height is searched
    up, source = override.up / np.linalg.norm(override.up), "manual_up"
    settings = dataclasses.replace(settings, max_tilt_deg=1.0)
  found = _search(evidence, up, settings, max_gap)
  warnings: tuple[str, ...] = ()
  if not found.dense_trusted:
    warnings = (
      "The field's depth shows its floor well above that of the sparse points: the field is "
      "blurred, and so will be its contact geometry. Train it longer; floor, yaw and extent are "
      "taken from the sparse points.",
    )
  if override.up is not None:
    floor = found.floor
    moved = floor.offset + float((up - floor.normal) @ evidence.positions.mean(0))
    found = found._replace(floor=floor._replace(normal=up, offset=moved))
  return Choice(found, source, warnings)


def _search(
  evidence: Evidence, up: np.ndarray, settings: FloorSettings, max_gap: float
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
  return FoundFloor(dense, True) if above < max_gap else FoundFloor(sparse, False)


def _thin(points: np.ndarray) -> np.ndarray:
  """Dense points with equal weight for equal area: close surfaces fill many pixels."""
  size = 0.01 * float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1)))
  _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
  return points[first]
