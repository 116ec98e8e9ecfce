"""Stages that find the world frame: before the training from sparse points, then from depth.

Each runs, or finds done, one stage of the cache: a function of earlier results and settings.
"""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

from nerf2real.core.progress import Progress, part
from nerf2real.core.serialization import read_json, write_json
from nerf2real.scenes.alignment import markers, world_frame
from nerf2real.scenes.alignment.evidence import Evidence
from nerf2real.scenes.alignment.floor import FloorError
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.geometry import fusion
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.stages.cache import Made, Stages
from nerf2real.scenes.stages.results import Given

_OUTLOOK_VERSION = 4  # 3: markers' corners without rolling shutter; 4: tilts by the cameras' up
# 4: all tilts; 5: by the cameras' up; 6: tells the marker's place; 7: metres that are assumed
_WORLD_VERSION = 7
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
  given: Given,
  *,
  voxel: float,
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
    given: Overrides, and the side of a marker.
    voxel: Edge of the surface mesh's voxels [m].

  Raises:
    ValueError: No direction is up, or the room is too large for its voxels.
  """
  found = poses.value

  def write(folder: Path, progress: Progress) -> None:
    marker = None
    if given.marker_side is not None:
      images = [capture.value.folder / name for name in found.names]
      seen = markers.detect(images, progress=part(progress, 0.0, 0.8))
      if found.shutter is not None:
        seen = [
          d._replace(corners=found.shutter.straightened(d.corners, found.camera, d.view))
          for d in seen
        ]
      marker = markers.marker_scale(
        seen,
        camera=found.camera,
        frame_from_camera=found.world_from_camera,
        side=given.marker_side,
      )
    evidence = sparse_evidence(capture.value, found, marker)
    try:
      frame = world_frame.align(
        evidence, settings=settings, override=given.override, progress=part(progress, 0.8, 1.0)
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

  everything = _key(settings, given)
  everything["voxel"] = voxel
  inputs = {"poses": poses.stamp}
  stage = cache.run("outlook", write, settings=everything, inputs=inputs, version=_OUTLOOK_VERSION)
  found_out = read_json(stage.folder / "outlook.json", Outlook)
  for text in found_out.warnings:
    warnings.warn(text, stacklevel=2)
  return Made(found_out, stage)


def sparse_evidence(
  capture: Capture, poses: Localisation, marker: markers.MarkerScale | None
) -> Evidence:
  """What is known of the world frame before there is a field."""
  known = capture.known
  is_metric = known is not None and known.is_metric
  return Evidence(
    poses.points,
    poses.world_from_camera,
    marker=marker,
    sensor_scale=1 / poses.unit_from_source.scale if is_metric else None,
    metres_assumed=known is not None and not known.names_unit,
    up=capture.unit_up,
  )


def _key(settings: world_frame.AlignSettings, given: Given) -> dict[str, Any]:
  """What the world frame depends on besides earlier results."""
  return {"align": settings, "marker_side": given.marker_side, "override": given.override_key}


def world(
  cache: Stages,
  capture: Made[Capture],
  poses: Made[Localisation],
  outlook: Made[Outlook],
  depth: Made[fusion.DepthViews],
  settings: world_frame.AlignSettings,
  given: Given,
) -> Made[world_frame.Alignment]:
  """Finds floor, scale, yaw and extent.

  Args:
    cache: The stages of the job.
    capture: The keyframes, which may have come with metric poses.
    poses: Cameras and sparse points, unit frame.
    outlook: The scale that markers give, and warnings.
    depth: Rendered depth, unit frame.
    settings: Of the alignment.
    given: Overrides, and the side of a marker.
  """

  def write(folder: Path, progress: Progress) -> None:
    points, normals = depth.value.surface_points(stride=2)
    evidence = sparse_evidence(capture.value, poses.value, outlook.value.scale)
    result = world_frame.align(
      evidence._replace(surface_points=points, surface_normals=normals),
      settings=settings,
      override=given.override,
      progress=progress,
    )
    if given.marker_side is not None and outlook.value.scale is None:
      missing = (
        f"No marker of side {given.marker_side} m was read consistently in three pictures or more: "
        "print it larger, lay it flat, film it from nearer."
      )
      result = dataclasses.replace(result, warnings=(*result.warnings, missing))
    result = dataclasses.replace(result, warnings=(*outlook.value.warnings, *result.warnings))
    write_json(folder / "alignment.json", result)

  everything = _key(settings, given)
  inputs = {"depth": depth.stamp, "outlook": outlook.stamp}
  stage = cache.run("world", write, settings=everything, inputs=inputs, version=_WORLD_VERSION)
  return Made(read_json(stage.folder / "alignment.json", world_frame.Alignment), stage)
