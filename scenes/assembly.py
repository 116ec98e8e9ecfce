"""Assembles a scene bundle from finished stages: files, figures, report, scene.json last."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from nerf2real.core import files
from nerf2real.core.serialization import to_plain
from nerf2real.scenes import bundle
from nerf2real.scenes.field.views import held_out_rows
from nerf2real.scenes.geometry import convex, floor_picture, map_server, mesh
from nerf2real.scenes.quality import held_out, report, sight_lines
from nerf2real.scenes.settings import SceneSettings
from nerf2real.scenes.stages.cache import StageResult
from nerf2real.scenes.stages.results import Measure, Reconstruction, SceneResults

_NOTICEABLE_EXPOSURE = 1.25  # a ratio above this is warned of
_ROBOT_VIEWS = 8  # held-out views shown at robot resolution where no truth gives better ones
_MAP_HEIGHT = 600  # of the report's map [pixel]


def assemble(
  results: SceneResults,
  out: Path,
  *,
  name: str,
  settings: SceneSettings,
  stages: Mapping[str, StageResult],
  measure: Measure | None,
) -> bundle.Bundle:
  """Copies the results together, measures them against a truth and writes report and scene.json.

  Args:
    results: What the stages made.
    out: The bundle's folder.
    name: The scene's name.
    settings: Settings of the job.
    stages: All stages that ran, for their keys and times.
    measure: Measures against a truth, or None.
  """
  (out / "scene.json").unlink(missing_ok=True)
  _copy_files(results, out)
  parts, judged = results.contact.value.parts, results.errors.value.judgement
  figures = _figures(results)
  if judged is not None:
    figures |= _sight_line_figures(judged)
  if measure is not None:
    truth = measure(_reconstruction(results, parts, collision_top=settings.collision.top))
    figures |= truth.figures
    robot_views = truth.robot_views
  else:
    robot_views = _robot_views(results)
  baseline: Mapping[str, np.ndarray] = {}
  if results.baseline is not None:
    baseline = np.load(results.baseline.stage.folder / "views.npz")
    figures |= results.baseline.value
  capture, poses, alignment = results.capture.value, results.poses.value, results.world.value
  seconds = {stage: result.seconds for stage, result in stages.items()}
  warnings = [*capture.warnings, *map(capture.told, poses.warnings), *alignment.warnings]
  if (lost := capture.without_place(poses.names)) is not None:
    warnings.append(lost)
  ratio = figures.get("exposure_ratio", 1.0)
  if ratio > _NOTICEABLE_EXPOSURE:
    warnings.append(
      f"Exposure changed by a factor of {ratio:.1f} while filming. It was evened out, but clipped "
      "highlights stay; lock the phone's exposure."
    )
  if judged is not None and judged.unfit is not None:
    warnings.append(judged.unfit)
  floor = map_server.read(out / "free_space.yaml")
  figures["free_area_apart_m2"] = floor.area_apart
  if floor.passage_lacks is not None:
    figures["passage_lacks_m"] = floor.passage_lacks
  if not floor.reachable.any():
    warnings.append(f"{floor.why_full} The scene can be looked at and exported, not trained in.")
  goals = results.contact.value.floor.goals
  tracked = capture.known is not None and capture.known.is_metric
  report.write(
    out / "report.html",
    report.ReportData(
      title=f"Scene {name}",
      lead=f"Made from {results.source.path.name}: a radiance field, contact geometry and a world "
      "frame.",
      figures=figures,
      seconds=seconds,
      warnings=warnings,
      settings=to_plain(settings),
      keyframes=capture.images,
      names=capture.names,
      strategy=poses.strategy,
      cameras=alignment.world_from_unit.apply(poses.world_from_camera[:, :3, 3]),
      filmed=capture.times is not None or tracked,
      views=held_out.load_scores(results.figures.stage.folder),
      robot_views=robot_views,
      baseline=baseline,
      visual=mesh.load_glb(out / "visual.glb"),
      collision=[trimesh.Trimesh(part.vertices, part.faces) for part in parts],
      floor=floor_picture.draw(
        floor,
        (alignment.extent_lower, alignment.extent_upper),
        height=_MAP_HEIGHT,
      ),
      goals=goals,
    ),
  )
  scene = {
    "name": name,
    "source": {
      "name": results.source.path.name,
      "kind": capture.kind,
      "sha256": results.source.sha256,
    },
    "settings": settings,
    "hashes": {stage: result.key for stage, result in stages.items()},
    "world_from_unit": alignment.world_from_unit,
    "scale": alignment.scale_source,
    "alignment": alignment,
    "extent": {"lower": alignment.extent_lower, "upper": alignment.extent_upper},
    "goals": goals,
    "views": views_of(alignment.world_from_unit.apply_pose(poses.world_from_camera)),
    "camera": poses.camera,
    "collision_parts": sorted(file.name for file in (out / "collision").glob("part_*.obj")),
    "figures": figures,
    "seconds": seconds,
    "warnings": warnings,
  }
  bundle.write_scene(out, scene)
  return bundle.Bundle.load(out)


def views_of(world_from_camera: np.ndarray) -> dict[str, np.ndarray]:
  """What scene.json says of where pictures were taken, of their poses [N, 4, 4]."""
  return {
    "position": np.round(world_from_camera[:, :3, 3], 3),
    "axis": np.round(world_from_camera[:, :3, 2], 3),
  }


def _copy_files(results: SceneResults, out: Path) -> None:
  for stage, item in (
    (results.poses.stage, "sfm"),
    (results.field.stage, "field.safetensors"),
    (results.surface, "visual.glb"),
    (results.contact.stage, "collision"),
    (results.contact.stage, "free_space.pgm"),
    (results.contact.stage, "free_space.yaml"),
  ):
    files.copy_atomically(stage.folder / item, out / item)


def _figures(results: SceneResults) -> dict[str, Any]:
  capture, poses, alignment = results.capture.value, results.poses.value, results.world.value
  quality, contact = results.figures.value, results.contact.value
  error = results.errors.value.distances
  return {
    "keyframes": len(capture.images),
    "registered_fraction": poses.registered_fraction,
    "reprojection_error_px": poses.reprojection_error_px,
    "focal_length_px": 0.5 * (poses.camera.fx + poses.camera.fy),
    **quality,
    "robot_psnr_db": quality["held_out_psnr_30x40_db"],
    "collision_error_m": error.p95,
    "collision_error": to_plain(error),
    "collision_parts": len(contact.parts),
    "free_area_m2": contact.floor.area_m2,
    "moved_to_floor": results.moved.to_floor,
    "moved_to_planes": results.moved.to_planes,
    "floor_tilt_from_cameras_deg": alignment.floor_tilt_from_cameras_deg,
    "scale_source": alignment.scale_source,
    "scale_spread": alignment.scale_spread,
    **({} if alignment.marker is None else {"marker_place": alignment.marker.words}),
  }


def _sight_line_figures(found: sight_lines.Judgement) -> dict[str, float]:
  return {
    "sight_lines": found.lines,
    "sight_lines_blocked": found.blocked,
    "sight_lines_blocked_p95_m": found.blocked_p95,
    "points_missed": found.missed,
    "points_to_parts_p95_m": found.distance_p95,
  }


def _reconstruction(
  results: SceneResults, parts: list[convex.Part], *, collision_top: float
) -> Reconstruction:
  """Gathers what is measured against a truth; no frame times where the capture was no video."""
  capture, poses = results.capture.value, results.poses.value
  times = np.zeros(0)
  if capture.times is not None:
    names = [path.name for path in capture.images]
    times = capture.times[[names.index(name) for name in poses.names]]
  return Reconstruction(
    poses,
    results.field.value.renderer,
    results.world.value,
    parts,
    results.depth,
    times,
    collision_top,
    held_out_rows(len(poses.names), results.pictures.held_out_every),
  )


def _robot_views(results: SceneResults) -> list[held_out.ViewScore]:
  """Held-out views at the robot's resolution."""
  views, renderer = results.pictures.held_out(), results.field.value.renderer
  shown = range(min(_ROBOT_VIEWS, len(views)))
  return [held_out.compare(renderer, views, k, *held_out.ROBOT_SIZES[0]) for k in shown]
