"""Stages that make geometry of depth: world frame, surface mesh, contact geometry with free floor.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import dataclasses
import warnings
from pathlib import Path

import numpy as np

from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import read_json, write_json
from nerf2real.scenes.alignment import markers, world_frame
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.floor import FloorError
from nerf2real.scenes.alignment.overrides import Overrides
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.geometry import collision, decomposition, floor_plan, fusion, map_server, mesh
from nerf2real.scenes.poses.localise import Localisation
from nerf2real.scenes.quality import collision_error
from nerf2real.scenes.results import Contact
from nerf2real.scenes.stages import Made, StageResult, Stages

_OUTLOOK_VERSION = 2  # 2: no floor among the localised points is warned of
_WORLD_VERSION = 3  # 2: the axes are unique; 3: markers are looked for before
_CONTACT_VERSION = 2  # 2: unseen space is matter behind seen matter alone; no tolerance grows
_NO_FLOOR = "No localised point lies on a floor; it is looked for again in the field's depth."


@dataclasses.dataclass(frozen=True)
class Outlook:
  """What is known of the world frame before the training."""

  scale: markers.MarkerScale | None
  """The scale that markers give; None without one."""
  warnings: tuple[str, ...] = ()


def outlook(
  cache: Stages,
  capture: Made[Capture],
  poses: Made[Localisation],
  settings: world_frame.AlignSettings,
  *,
  voxel: float,
  marker_side: float | None,
  override: Overrides,
  override_key: str,
) -> Made[Outlook]:
  """Finds markers, and refuses before the training what it could not help.

  A world frame is found from the sparse points alone: where the scale makes the cameras' walk
  larger than a grid of voxels may be, the stages after the training would fail. A floor that shows
  in no localised point may show in the field's depth: it is warned of, at once and in the report.

  Args:
    cache: The stages of the job.
    capture: The keyframes, in which markers are looked for.
    poses: Cameras and sparse points, unit frame.
    settings: Of the alignment.
    voxel: Edge of the surface mesh's voxels [m].
    marker_side: Side of the black square of a marker in the room [m], or None.
    override: What a person fixed.
    override_key: Hash of the file that says so.

  Raises:
    ValueError: No direction is up, or the room is too large for its voxels.
  """
  found = poses.value

  def write(folder: Path, progress: Progress) -> None:
    marker = None
    if marker_side is not None:
      images = [capture.value.folder / name for name in found.names]
      marker = markers.marker_scale(
        markers.detect(images, progress=part(progress, 0.0, 0.8)),
        camera=found.camera,
        frame_from_camera=found.world_from_camera,
        side=marker_side,
      )
    evidence = Evidence(
      found.points,
      found.world_from_camera,
      marker=marker,
      sensor_scale=_sensed_scale(capture.value, found),
    )
    try:
      frame = world_frame.align(
        evidence, settings=settings, override=override, progress=part(progress, 0.8, 1.0)
      )
    except FloorError as error:
      write_json(folder / "outlook.json", Outlook(marker, (f"{_NO_FLOOR} {error}",)))
      return
    # Sparse points stray; but the extent will hold every camera, and the floor below it.
    cameras = frame.world_from_unit.apply(evidence.positions)
    top = min(frame.camera_height, settings.max_height)
    try:
      fusion.grid_shape([*cameras.min(0)[:2], 0.0], [*cameras.max(0)[:2], top], voxel)
    except ValueError as error:
      raise ValueError(
        f"{error} That box holds the cameras alone; its scale is from {frame.scale_source}: give "
        "lengths in metres."
      ) from error
    write_json(folder / "outlook.json", Outlook(marker))

  everything = {"align": settings, "marker_side": marker_side, "override": override_key}
  everything["voxel"] = voxel
  inputs = {"poses": poses.stamp}
  stage = cache.run("outlook", write, settings=everything, inputs=inputs, version=_OUTLOOK_VERSION)
  found_out = read_json(stage.folder / "outlook.json", Outlook)
  for text in found_out.warnings:
    warnings.warn(text, stacklevel=2)
  return Made(found_out, stage)


def _sensed_scale(capture: Capture, poses: Localisation) -> float | None:
  """Metres a unit of length of poses that came with the capture; None where they are not metric."""
  known = capture.known
  return 1 / poses.unit_from_source.scale if known is not None and known.is_metric else None


def world(
  cache: Stages,
  capture: Made[Capture],
  poses: Made[Localisation],
  outlook: Made[Outlook],
  depth: Made[fusion.DepthViews],
  settings: world_frame.AlignSettings,
  *,
  marker_side: float | None,
  override: Overrides,
  override_key: str,
) -> Made[world_frame.Alignment]:
  """Finds floor, scale, yaw and extent.

  Args:
    cache: The stages of the job.
    capture: The keyframes, which may have come with metric poses.
    poses: Cameras and sparse points, unit frame.
    outlook: The scale that markers give, and warnings.
    depth: Rendered depth, unit frame.
    settings: Of the alignment.
    marker_side: Side of the black square of a marker in the room [m], or None.
    override: What a person fixed.
    override_key: Hash of the file of overrides.
  """
  found = poses.value

  def write(folder: Path, progress: Progress) -> None:
    points, normals = depth.value.surface_points(stride=2)
    sensed = _sensed_scale(capture.value, found)
    result = world_frame.align(
      Evidence(found.points, found.world_from_camera, points, normals, outlook.value.scale, sensed),
      settings=settings,
      override=override,
      progress=progress,
    )
    if marker_side is not None and outlook.value.scale is None:
      missing = (
        f"No marker of side {marker_side} m was read consistently in three pictures or more: "
        "print it larger, lay it flat, film it from nearer."
      )
      result = dataclasses.replace(result, warnings=(*result.warnings, missing))
    result = dataclasses.replace(result, warnings=(*outlook.value.warnings, *result.warnings))
    write_json(folder / "alignment.json", result)

  everything = {"align": settings, "marker_side": marker_side, "override": override_key}
  inputs = {"depth": depth.stamp, "outlook": outlook.stamp}
  stage = cache.run("world", write, settings=everything, inputs=inputs, version=_WORLD_VERSION)
  return Made(read_json(stage.folder / "alignment.json", world_frame.Alignment), stage)


def surface(
  cache: Stages,
  world: Made[world_frame.Alignment],
  depth: fusion.DepthViews,
  settings: mesh.MeshSettings,
) -> StageResult:
  """Makes the coloured surface mesh of depth in the world frame."""

  def write(folder: Path, progress: Progress) -> None:
    grid = fusion.fuse(
      depth,
      lower=world.value.extent_lower,
      upper=world.value.extent_upper,
      voxel=settings.voxel,
      truncation=settings.truncation,
      progress=part(progress, 0.0, 0.5),
    )
    grid = mesh.drop_floaters(grid, min_component=settings.min_component)
    found = mesh.drop_small_pieces(mesh.surface(grid), min_component=settings.min_component)
    progress(0.7, "fewer faces")
    found = mesh.simplify(found, faces=settings.visual_faces)
    progress(0.8, "colours")
    mesh.save_glb(mesh.paint(found, depth), folder / "visual.glb")

  return cache.run("surface", write, settings=settings, inputs={"world": world.stamp})


def contact(
  cache: Stages,
  world: Made[world_frame.Alignment],
  depth: fusion.DepthViews,
  collision_settings: collision.CollisionSettings,
  floor_settings: floor_plan.FreeSpaceSettings,
) -> Made[Contact]:
  """Makes the convex parts and the map of the free floor of depth in the world frame."""
  place = world.value

  def write(folder: Path, progress: Progress) -> None:
    shape = dataclasses.replace(collision_settings, floor_threshold=place.floor_threshold)
    grid = collision.solid_grid(
      depth,
      lower=place.extent_lower,
      upper=place.extent_upper,
      settings=shape,
      progress=part(progress, 0.0, 0.2),
    )
    parts = decomposition.decompose(grid, settings=shape.parts, progress=part(progress, 0.2, 0.8))
    collision.write_parts(parts, folder / "collision")
    progress(0.8, "free space")
    space = floor_plan.floor_plan(
      parts,
      lower=place.extent_lower,
      upper=place.extent_upper,
      seen=grid,
      settings=floor_settings,
    )
    map_server.write(space, folder / "free_space.pgm")
    goals = space.default_goals(count=floor_settings.goals, clearance=floor_settings.goal_clearance)
    progress(0.85, "distance to the seen surface")
    error = collision_error.collision_error(
      parts,
      depth.surface_points(stride=2)[0],
      eyes=depth.positions,
      lower=place.extent_lower,
      upper=np.minimum(place.extent_upper, [np.inf, np.inf, shape.top]),
      floor_threshold=place.floor_threshold,
    )
    figures = Contact(
      goals=goals,
      free_area_m2=space.area,
      collision_parts=len(parts),
      collision_error_m=error.p95,
      collision_error=error,
    )
    write_json(folder / "contact.json", figures)

  everything = [collision_settings, floor_settings]
  inputs = {"world": world.stamp}
  stage = cache.run("contact", write, settings=everything, inputs=inputs, version=_CONTACT_VERSION)
  return Made(read_json(stage.folder / "contact.json", Contact), stage)
