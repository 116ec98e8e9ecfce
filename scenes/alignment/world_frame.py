"""Aligns the model with the world frame: metres, z up, floor at z = 0, walls along the axes or the
axes from a marker.

Does automatically what the paper does by hand in Blender (section "Collision mesh extraction");
every choice can be overridden (`scenes.alignment.overrides`). Shapes: N cameras, P points.
"""

import dataclasses

import numpy as np

from nerf2real.core.geometry import rotations, similarity
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.alignment.evidence import Choice, Evidence
from nerf2real.scenes.alignment.extent import choose_extent
from nerf2real.scenes.alignment.floor import (
  UNLIKELY,
  Floor,
  FloorSettings,
  cameras_up,
  choose_floor,
  refine_floor,
)
from nerf2real.scenes.alignment.marker_place import MarkerPlace, place_of
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.alignment.scale import Scale, choose_scale
from nerf2real.scenes.alignment.yaw import choose_yaw

_ABOVE_FLOOR = 0.1  # m: points above belong to the room, not to its floor


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignSettings:
  """Settings of the alignment; lengths in metres unless said otherwise."""

  guessed_camera_height: float = 1.4
  """Of a phone held by a standing adult, if nothing gives scale."""
  camera_height: float | None = None
  """Known median height of the camera above the floor."""
  marker_at: MarkerPlace | None = None
  """Where the marker is to be in the world, which gives origin and axes: the same in every film of
  the room. None: the origin is the middle of the room, the axes lie along its walls."""
  max_marker_spread: float = 0.03
  """a marker whose scale is less certain (relative) is not used."""
  margin: float = 0.15
  """Added around the extent, so that walls are inside."""
  camera_margin: float = 0.4
  """The extent holds every camera with this much room around it."""
  max_height: float = 2.6
  """Top of the extent; a ceiling seldom touches a robot."""
  outliers: float = 0.01
  """Share of surface cells outside the extent, on each side."""
  floor: FloorSettings = dataclasses.field(default_factory=FloorSettings)
  floor_threshold: float = 0.04
  """Matter below this height counts as floor."""
  max_floor_gap: float = 0.1
  """Dense above sparse floor, share of the cameras' height: a bad field."""
  refine_tolerance: float = 0.04
  """Of dense points about the floor."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alignment:
  """The world frame and the sources of its parts."""

  world_from_unit: similarity.Similarity
  extent_lower: np.ndarray
  """[3] m, world frame; z is the floor, 0."""
  extent_upper: np.ndarray
  """[3] m, world frame."""
  scale_source: str
  """"marker", "depth_sensor", "points", "camera_height", "manual" or "unknown"."""
  scale_spread: float | None
  """Relative standard deviation, where it is known."""
  floor_source: str
  """"plane", "manual_points" or "manual_up"."""
  floor_residual: float
  """Root mean square distance of the floor's points [m]."""
  floor_points: int
  """Points that carry the floor."""
  floor_tilt_from_cameras_deg: float
  """floor's normal against the cameras' up direction."""
  floor_threshold: float
  """m."""
  yaw_source: str
  """"walls", "points", "marker" or "manual"."""
  camera_height: float
  """Median height of the cameras above the floor [m]."""
  marker: MarkerPlace | None = None
  """Where a marker lies in the world: what places on the map are measured from in the room."""
  warnings: tuple[str, ...] = ()


def align(
  evidence: Evidence,
  *,
  settings: AlignSettings | None = None,
  override: Overrides | None = None,
  progress: Progress = no_progress,
) -> Alignment:
  """Finds the world frame: floor, scale, yaw and extent.

  Args:
    evidence: Points, cameras and marker in the unit frame.
    settings: Settings.
    override: Values given by hand.
    progress: Called with the fraction done and a text.

  Raises:
    ValueError: No floor was found, or the extent is empty.
  """
  settings, override = settings or AlignSettings(), override or Overrides()
  evidence = evidence.thinned()
  progress(0.0, "floor")
  found = choose_floor(evidence, override, settings=settings.floor, max_gap=settings.max_floor_gap)
  floor = found.value.floor
  if not found.value.dense_trusted:
    evidence = evidence.sparse()

  def scale_above(floor: Floor) -> Choice[Scale]:
    return choose_scale(
      evidence,
      override,
      floor=floor,
      camera_height=settings.camera_height,
      guessed_camera_height=settings.guessed_camera_height,
      max_marker_spread=settings.max_marker_spread,
    )

  if found.source == "plane" and evidence.surface_points is not None:
    rough = scale_above(floor).value.metres_per_unit
    floor = refine_floor(
      floor, evidence.surface_points, tolerance=settings.refine_tolerance / rough
    )
  scale = scale_above(floor)
  metres = scale.value.metres_per_unit

  progress(0.4, "yaw")
  heights = floor.heights(evidence.densest) * metres
  rotation = choose_yaw(
    evidence,
    override,
    upright=rotations.rotation_to_up(floor.normal),
    in_room=(heights > _ABOVE_FLOOR) & (heights < settings.max_height),
    marker_at=settings.marker_at,
  )

  progress(0.7, "extent")
  extent = choose_extent(
    evidence,
    override,
    metric=similarity.Similarity(metres, rotation.value, np.zeros(3)),
    floor_height=floor.offset * metres,
    max_height=settings.max_height,
    outliers=settings.outliers,
    margin=settings.margin,
    camera_margin=settings.camera_margin,
    marker_at=settings.marker_at,
  )
  world_from_unit = similarity.Similarity(metres, rotation.value, -extent.origin)
  progress(1.0, "aligned")
  up = cameras_up(evidence, override)
  tilt = float(np.degrees(np.arccos(np.clip(floor.normal @ up.direction, -1, 1))))
  warnings = found.warnings + scale.warnings + rotation.warnings
  if found.source == "plane" and up.deviations(floor.normal) > UNLIKELY:
    warnings += (
      f"The floor tilts {tilt:.0f} degrees against the cameras' up direction, more than they are "
      "held askew: check it in the report, and give floor_points in the override file if it is "
      "wrong.",
    )
  return Alignment(
    world_from_unit=world_from_unit,
    extent_lower=extent.lower,
    extent_upper=extent.upper,
    scale_source=scale.source,
    scale_spread=scale.value.spread,
    floor_source=found.source,
    floor_residual=floor.residual * metres,
    floor_points=floor.points,
    floor_tilt_from_cameras_deg=tilt,
    floor_threshold=override.floor_threshold or settings.floor_threshold,
    yaw_source=rotation.source,
    camera_height=float(np.median(floor.heights(evidence.positions))) * metres,
    marker=None if evidence.marker is None else place_of(evidence.marker, world_from_unit),
    warnings=warnings,
  )
