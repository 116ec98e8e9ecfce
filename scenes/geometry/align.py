"""From the model's frame to the world: metres, z up, floor at z = 0, walls along the axes.

Does automatically what the paper does by hand in Blender (section "Collision mesh extraction");
every choice can be overridden (`scenes.geometry.overrides`). Shapes: N cameras, P points.
"""

import dataclasses

import numpy as np

from nerf2real.core import rotations, similarity
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import floor as floors
from nerf2real.scenes.geometry import markers, overrides

_MAX_DENSE = 300_000  # surface points that take part


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignSettings:
  """Settings of the alignment; lengths in metres unless said otherwise."""

  guessed_camera_height: float = 1.4  # of a phone held by a standing adult, if nothing gives scale
  camera_height: float | None = None  # known median height of the camera above the floor
  max_marker_spread: float = 0.03  # a marker whose scale is less certain (relative) is not used
  margin: float = 0.15  # added around the extent, so that walls are inside
  camera_margin: float = 0.4  # the extent holds every camera with this much room around it
  max_height: float = 2.6  # top of the extent; a ceiling seldom touches a robot
  outliers: float = 0.01  # share of surface cells outside the extent, on each side
  floor: floors.FloorSettings = dataclasses.field(default_factory=floors.FloorSettings)
  floor_threshold: float = 0.04  # matter below this height counts as floor
  max_floor_gap: float = 0.1  # dense above sparse floor, share of the cameras' height: a bad field
  refine_tolerance: float = 0.04  # of dense points about the floor


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alignment:
  """The world frame and what it rests on."""

  world_from_unit: similarity.Similarity
  extent_lower: np.ndarray  # [3] m, world frame; z is the floor, 0
  extent_upper: np.ndarray  # [3] m, world frame
  scale_source: str  # "marker", "points", "camera_height", "manual" or "unknown"
  scale_spread: float | None  # relative standard deviation, where it is known
  floor_source: str  # "plane", "manual_points" or "manual_up"
  floor_residual: float  # root mean square distance of the floor's points [m]
  floor_points: int  # points that carry the floor
  floor_tilt_from_cameras_deg: float  # floor's normal against the cameras' mean up direction
  floor_threshold: float  # m
  yaw_source: str  # "walls", "points" or "manual"
  camera_height: float  # median height of the cameras above the floor [m]
  warnings: tuple[str, ...] = ()

  def tilt_deg(self, true_up: np.ndarray) -> float:
    """Angle between the world's z axis and a true up direction [3] of the unit frame."""
    up = self.world_from_unit.rotation @ (true_up / np.linalg.norm(true_up))
    return float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))


def wall_yaw(normals: np.ndarray, *, weights: np.ndarray | None = None) -> float | None:
  """Direction of the walls from normals [P, 3], z up: an angle in [0, pi/2), or None.

  The mode of the angles modulo a quarter turn, refined by their circular mean near it.
  """
  level = np.hypot(normals[:, 0], normals[:, 1])
  upright = (level > 0.95) & (np.abs(normals[:, 2]) < 0.3)
  if upright.sum() < 100:
    return None
  angle = np.mod(np.arctan2(normals[upright, 1], normals[upright, 0]), np.pi / 2)
  share = np.ones(len(angle)) if weights is None else weights[upright]
  bins = 90
  counts, _ = np.histogram(angle, bins, (0, np.pi / 2), weights=share)
  smooth = sum((np.roll(counts, shift) for shift in range(-3, 4)), np.zeros(bins))
  mode = (np.argmax(smooth) + 0.5) * np.pi / 2 / bins
  if smooth.max() < 1.5 * 7 / bins * counts.sum():  # no direction stands out
    return None
  width = np.radians(8)
  for _ in range(5):
    offset = np.mod(angle - mode + np.pi / 4, np.pi / 2) - np.pi / 4
    kernel = share * np.exp(-0.5 * (offset / (width / 2)) ** 2)
    mode += float((kernel * offset).sum() / kernel.sum())
    width = max(width * 0.7, np.radians(3))
  return float(np.mod(mode, np.pi / 2))


def point_yaw(points: np.ndarray) -> float:
  """Direction of the walls from points [P, 3] with z up: the least entropy of both projections."""
  flat = points[:, :2] - np.median(points[:, :2], axis=0)
  flat = flat[np.linalg.norm(flat, axis=-1) < np.percentile(np.linalg.norm(flat, axis=-1), 98)]
  span = np.abs(flat).max()

  def entropy(angle: float) -> float:
    turned = flat @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    total = 0.0
    for axis in range(2):
      counts, _ = np.histogram(turned[:, axis], 200, (-1.5 * span, 1.5 * span))
      share = counts[counts > 0] / len(flat)
      total -= (share * np.log(share)).sum()
    return total

  coarse = np.radians(np.arange(0, 90, 1.0))
  best = coarse[np.argmin([entropy(a) for a in coarse])]
  fine = best + np.radians(np.arange(-1, 1.01, 0.1))
  return float(np.mod(fine[np.argmin([entropy(a) for a in fine])], np.pi / 2))


def _cells(points: np.ndarray, size: float) -> np.ndarray:
  """One point for each occupied cube of this size: surface counts by area, not by pixels."""
  return (np.unique(np.floor(points / size).astype(np.int64), axis=0) + 0.5) * size


def align(
  *,
  points: np.ndarray,
  frame_from_camera: np.ndarray,
  surface_points: np.ndarray | None = None,
  surface_normals: np.ndarray | None = None,
  marker: markers.MarkerScale | None = None,
  settings: AlignSettings | None = None,
  override: overrides.Overrides | None = None,
  progress: Progress = no_progress,
) -> Alignment:
  """Finds the world frame.

  The scale comes from, in this order: the override file, a marker, a known camera height, a guess.

  Args:
    points: Sparse points [P, 3], unit frame.
    frame_from_camera: Camera poses [N, 4, 4], unit frame.
    surface_points: Dense surface points [Q, 3] (lifted depth or mesh vertices), unit frame; they
      refine the floor, the yaw and the extent.
    surface_normals: Their normals [Q, 3].
    marker: Scale from a marker.
    settings: Settings.
    override: What a person fixed.
    progress: Called with the fraction done and a text.

  Raises:
    ValueError: no floor was found.
  """
  settings, override = settings or AlignSettings(), override or overrides.Overrides()
  warnings: list[str] = []
  positions = frame_from_camera[:, :3, 3]
  if surface_points is not None and len(surface_points) > _MAX_DENSE:
    chosen = np.random.default_rng(0).choice(len(surface_points), _MAX_DENSE, replace=False)
    surface_points = surface_points[chosen]
    surface_normals = None if surface_normals is None else surface_normals[chosen]
  dense = points if surface_points is None else surface_points
  camera_up = np.array([0.0, 0, 1])
  try:
    camera_up = floors.mean_up(frame_from_camera)
  except ValueError:
    if override.up is None and override.floor_points is None:
      raise

  progress(0.0, "floor")
  if override.floor_points is not None:
    normal, offset = floors.fit_plane(override.floor_points, camera_up)
    error = override.floor_points @ normal - offset
    plane = floors.Floor(normal, offset, len(error), 0.0, float(np.sqrt(np.mean(error**2))), 0.0)
    floor_source = "manual_points"
  else:
    up = camera_up if override.up is None else override.up / np.linalg.norm(override.up)
    search = settings.floor
    if override.up is not None:  # a person's up is exact: only the height is searched
      search = dataclasses.replace(search, max_tilt_deg=1.0)
    floor_source = "plane" if override.up is None else "manual_up"
    plane, trusted = _search(points, surface_points, positions, up, search, settings)
    if not trusted:
      warnings.append(
        "The field's depth shows its floor well above that of the sparse points: the field is "
        "blurred, and so will be its contact geometry. Train it longer; floor, yaw and extent are "
        "taken from the sparse points."
      )
      surface_points = surface_normals = None
      dense = points
    if override.up is not None:
      plane = plane._replace(
        normal=up, offset=plane.offset + float((up - plane.normal) @ positions.mean(0))
      )
  metres, scale_source, spread = _scale(plane, positions, marker, settings, override, warnings)
  if floor_source == "plane" and surface_points is not None:
    plane = floors.refine_floor(plane, surface_points, tolerance=settings.refine_tolerance / metres)
  if scale_source in ("camera_height", "unknown"):  # they rest on the floor just refined
    metres, _, _ = _scale(plane, positions, marker, settings, override, [])
  tilt = float(np.degrees(np.arccos(np.clip(plane.normal @ camera_up, -1, 1))))
  if tilt > 15:
    warnings.append(
      f"The floor tilts {tilt:.0f} degrees against the cameras' mean up direction: check it in the "
      "report, and give floor_points in the override file if it is wrong."
    )

  progress(0.4, "yaw")
  upright = rotations.rotation_to_up(plane.normal)
  heights = plane.heights(dense) * metres
  band = (heights > 0.1) & (heights < settings.max_height)
  if override.yaw_deg is not None:
    yaw, yaw_source = np.radians(override.yaw_deg), "manual"
  else:
    yaw, yaw_source = None, "walls"
    if surface_normals is not None:
      yaw = wall_yaw(surface_normals[band] @ upright.T)
    if yaw is None:
      yaw, yaw_source = (
        point_yaw((dense[band] if band.sum() > 100 else dense) @ upright.T),
        "points",
      )
  rotation = rotations.yaw_matrix(-yaw) @ upright
  if override.yaw_deg is None:
    rotation = _longer_side_along_x(rotation, dense[band] if band.any() else dense)

  progress(0.7, "extent")
  base = similarity.Similarity(metres, rotation, np.zeros(3))
  surface = base.apply(dense)
  cameras_world = base.apply(positions)
  height = plane.offset * metres
  surface[:, 2] -= height
  cameras_world[:, 2] -= height
  inside = surface[(surface[:, 2] > -0.1) & (surface[:, 2] < settings.max_height + 0.5)]
  cells = _cells(inside if len(inside) > 100 else surface, 0.1)
  lower = np.quantile(cells, settings.outliers, axis=0) - settings.margin
  upper = np.quantile(cells, 1 - settings.outliers, axis=0) + settings.margin
  lower = np.minimum(lower, cameras_world.min(0) - settings.camera_margin)
  upper = np.maximum(upper, cameras_world.max(0) + settings.camera_margin)
  centre = 0.5 * (lower + upper)
  if override.origin is not None:
    picked = override.origin if len(override.origin) == 3 else np.append(override.origin, 0.0)
    centre = base.apply(picked)
  shift = np.array([centre[0], centre[1], 0.0])
  lower, upper = lower - shift, upper - shift
  lower[2], upper[2] = 0.0, min(upper[2], settings.max_height)
  if override.extent_lower is not None:
    lower = override.extent_lower
  if override.extent_upper is not None:
    upper = override.extent_upper
  if not (lower < upper).all():
    raise ValueError(
      f"The extent is empty: lower {np.round(lower, 2).tolist()}, upper "
      f"{np.round(upper, 2).tolist()} m. Correct extent_lower and extent_upper in the override "
      "file."
    )
  progress(1.0, "aligned")
  return Alignment(
    world_from_unit=similarity.Similarity(metres, rotation, -shift - np.array([0, 0, height])),
    extent_lower=lower,
    extent_upper=upper,
    scale_source=scale_source,
    scale_spread=spread,
    floor_source=floor_source,
    floor_residual=plane.residual * metres,
    floor_points=plane.points,
    floor_tilt_from_cameras_deg=tilt,
    floor_threshold=override.floor_threshold or settings.floor_threshold,
    yaw_source=yaw_source,
    camera_height=float(np.median(plane.heights(positions))) * metres,
    warnings=tuple(warnings),
  )


def _search(points, surface_points, positions, up, search, settings):
  """Searches the floor in the dense and in the sparse points.

  Dense depth shows the textureless floor that sparse points miss; sparse points are right even
  where the field is a fog. Returns the floor and whether the dense points can be trusted.
  """
  found = []
  for cloud in (None if surface_points is None else _thin(surface_points), points):
    try:
      found.append(
        None
        if cloud is None
        else floors.find_floor(cloud, up=up, camera_positions=positions, settings=search)
      )
    except ValueError as error:
      found.append(None)
      reason = error
  dense, sparse = found
  if dense is None and sparse is None:
    raise reason
  if dense is None or sparse is None:
    return (dense, True) if sparse is None else (sparse, surface_points is None)
  centre = positions.mean(0)
  above = 1 - float(dense.heights(centre)) / float(sparse.heights(centre))
  return (dense, True) if above < settings.max_floor_gap else (sparse, False)


def _thin(points: np.ndarray) -> np.ndarray:
  """Dense points with equal weight for equal area: close surfaces fill many pixels."""
  size = 0.01 * float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1)))
  _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
  return points[first]


def _scale(plane, positions, marker, settings, override, warnings):
  """Metres per unit, where it comes from and its relative spread."""
  height = float(np.median(plane.heights(positions)))  # units
  if override.scale is not None:
    return override.scale, "manual", None
  if override.scale_points is not None:
    distance = float(np.linalg.norm(override.scale_points[1] - override.scale_points[0]))
    return override.scale_distance / distance, "points", None
  if override.camera_height is not None:
    return override.camera_height / height, "camera_height", None
  if marker is not None:
    if marker.spread <= settings.max_marker_spread:
      return marker.metres_per_unit, "marker", marker.spread
    warnings.append(
      f"The marker's scale is uncertain by {100 * marker.spread:.1f} %, more than "
      f"{100 * settings.max_marker_spread:g} %: not used. Film it from nearer and more sides."
    )
  if settings.camera_height is not None:
    return settings.camera_height / height, "camera_height", None
  guess = settings.guessed_camera_height
  warnings.append(
    f"SCALE UNKNOWN: guessed from a camera height of {guess:g} m and easily wrong by 20 %. Film a "
    "marker of known size, or give scale_points with scale_distance, camera_height or scale in the "
    "override file."
  )
  return guess / height, "unknown", None


def _longer_side_along_x(rotation: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Adds the quarter turns that put the longer side along x, nearest to the frame's own x axis."""
  spans = [np.ptp(np.quantile(points @ rotation[axis], [0.02, 0.98])) for axis in range(2)]
  if spans[1] > spans[0]:
    rotation = rotations.yaw_matrix(np.pi / 2) @ rotation
  return rotations.yaw_matrix(np.pi) @ rotation if rotation[0, 0] < 0 else rotation
