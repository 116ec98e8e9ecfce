"""Puts a bundle together from finished stages: files, figures, report, and scene.json last."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import trimesh

from nerf2real.core import files
from nerf2real.core.serialization import to_plain
from nerf2real.scenes import bundle
from nerf2real.scenes.field.render.renderer import Renderer
from nerf2real.scenes.geometry import align, collision, convex, free_space, fusion
from nerf2real.scenes.poses import localise
from nerf2real.scenes.quality import held_out as evaluate
from nerf2real.scenes.quality import report

if TYPE_CHECKING:
  from nerf2real.scenes.pipeline import Job

_NOTICEABLE_EXPOSURE = 1.25  # ours: a ratio above this is warned of
_ROBOT_VIEWS = 8  # held-out views shown at robot resolution where no truth gives better ones
_MAP_SCALE = 6  # pixels of the report's map per cell

_FILES = (  # stage and what it gives to the bundle
  ("poses", "sfm"),
  ("field", "field.safetensors"),
  ("surface", "visual.glb"),
  ("contact", "collision"),
  ("contact", "free_space.pgm"),
  ("contact", "free_space.yaml"),
)


class Reconstruction(NamedTuple):
  """What was made of a capture, for measurements against a truth."""

  localisation: localise.Localisation
  renderer: Renderer
  alignment: align.Alignment
  parts: list[convex.Part]
  depth: fusion.DepthViews  # in the world frame
  frame_times: np.ndarray  # of the registered keyframes in the video [N] [s]
  collision_top: float  # height up to which contact geometry is made [m]


class TruthFigures(NamedTuple):
  """What a measurement against a known truth returns."""

  figures: Mapping[str, Any]
  robot_views: list[evaluate.ViewScore]


Measure = Callable[[Reconstruction], TruthFigures]


def assemble(job: Job, out: Path, *, name: str, measure: Measure | None) -> bundle.Bundle:
  """Copies the results together, measures them against a truth and writes the report.

  Args:
    job: A job whose stages have all run.
    out: The bundle's folder.
    name: The scene's name.
    measure: Measures against a truth, or None.
  """
  (out / "scene.json").unlink(missing_ok=True)
  for stage, item in _FILES:
    files.copy_atomically(job.folder(stage) / item, out / item)
  contact = job.load("contact", "contact.json")
  parts = collision.read_parts(out / "collision")
  figures = _figures(job, contact)
  if measure is not None:
    truth = measure(
      Reconstruction(
        job.localisation,
        job.renderer,
        job.alignment,
        parts,
        job.world_depth,
        _frame_times(job),
        job.settings.collision.top,
      )
    )
    figures |= truth.figures
    robot_views = truth.robot_views
  else:
    robot_views = _robot_views(job)
  baseline: Mapping[str, np.ndarray] = {}
  if job.settings.baseline == "colmap":
    baseline = np.load(job.folder("baseline") / "views.npz")
    figures |= job.load("baseline", "figures.json")
  results = job.stages.results
  seconds = {stage: result.seconds for stage, result in results.items()}
  warnings = [*job.capture.warnings, *job.localisation.warnings, *job.alignment.warnings]
  ratio = figures.get("exposure_ratio", 1.0)
  if ratio > _NOTICEABLE_EXPOSURE:
    warnings.append(
      f"Exposure changed by a factor of {ratio:.1f} while filming. It was evened out, but clipped "
      "highlights stay; lock the phone's exposure."
    )
  settings = to_plain(job.settings)
  transform = job.alignment.world_from_unit
  path = transform.apply(job.localisation.world_from_camera[:, :3, 3])
  goals = np.array(contact["goals"])
  space = free_space.read(out / "free_space.yaml")
  report.write(
    out / "report.html",
    report.ReportData(
      title=f"Scene {name}",
      lead=f"Made from {job.source.name}: a radiance field, contact geometry and a world frame.",
      figures=figures,
      seconds=seconds,
      warnings=warnings,
      settings=settings,
      keyframes=job.capture.images,
      strategy=job.localisation.strategy,
      camera_path=path,
      views=evaluate.load_scores(job.folder("figures")),
      robot_views=robot_views,
      baseline=baseline,
      visual=trimesh.load_mesh(out / "visual.glb"),
      collision=[trimesh.Trimesh(part.vertices, part.faces) for part in parts],
      free_space_picture=_map_picture(space, goals, path),
    ),
  )
  scene = {
    "name": name,
    "source": {"name": job.source.name, "kind": job.capture.kind, "sha256": job.source_key},
    "settings": settings,
    "hashes": {stage: result.key for stage, result in results.items()},
    "world_from_unit": to_plain(transform),
    "scale": job.alignment.scale_source,
    "alignment": to_plain(job.alignment),
    "extent": {
      "lower": job.alignment.extent_lower.tolist(),
      "upper": job.alignment.extent_upper.tolist(),
    },
    "goals": contact["goals"],
    "camera": to_plain(job.localisation.camera),
    "collision_parts": sorted(path.name for path in (out / "collision").glob("part_*.obj")),
    "figures": figures,
    "seconds": seconds,
    "warnings": warnings,
  }
  bundle.write_scene(out, scene)
  return bundle.Bundle.load(out)


def _figures(job: Job, contact: Mapping[str, Any]) -> dict[str, Any]:
  held_out = job.load("figures", "figures.json")
  camera = job.localisation.camera
  return {
    "keyframes": len(job.capture.images),
    "registered_fraction": job.localisation.registered_fraction,
    "reprojection_error_px": job.localisation.reprojection_error_px,
    "focal_length_px": 0.5 * (camera.fx + camera.fy),
    **held_out,
    "robot_psnr_db": held_out["held_out_psnr_30x40_db"],
    "collision_error_m": contact["collision_error_m"],
    "collision_error": contact["collision_error"],
    "collision_parts": contact["collision_parts"],
    "free_area_m2": contact["free_area_m2"],
    "floor_tilt_from_cameras_deg": job.alignment.floor_tilt_from_cameras_deg,
    "scale_source": job.alignment.scale_source,
    "scale_spread": job.alignment.scale_spread,
  }


def _frame_times(job: Job) -> np.ndarray:
  """Times [N] of the registered keyframes [s]; empty where the capture was no video."""
  if job.capture.times is None:
    return np.zeros(0)
  names = [path.name for path in job.capture.images]
  return job.capture.times[[names.index(name) for name in job.localisation.names]]


def _robot_views(job: Job) -> list[evaluate.ViewScore]:
  """Held-out views at the robot's resolution."""
  _, held_out = job.views().split(job.settings.held_out_every)
  shown = range(min(_ROBOT_VIEWS, len(held_out)))
  return [evaluate.compare(job.renderer, held_out, k, *evaluate.ROBOT_SIZES[0]) for k in shown]


def _map_picture(space: free_space.FreeSpace, goals: np.ndarray, path: np.ndarray) -> np.ndarray:
  """Draws the map with goals [G, 2] and camera path [N, 3]: uint8 [H, W, 3], y upwards."""
  gray = np.full(space.cells.shape, 120, np.uint8)
  gray[space.cells == free_space.FREE] = 195
  gray[space.cells == free_space.OCCUPIED] = 30
  gray[space.reachable] = 255
  picture = cv2.cvtColor(gray[::-1].copy(), cv2.COLOR_GRAY2RGB)
  size = (picture.shape[1] * _MAP_SCALE, picture.shape[0] * _MAP_SCALE)
  picture = cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)

  def pixel(point: np.ndarray) -> tuple[int, int]:
    column, row = (np.asarray(point)[:2] - space.origin) / space.resolution * _MAP_SCALE
    return round(column), round(size[1] - row)

  line = np.array([pixel(point) for point in path], np.int32)
  cv2.polylines(picture, [line], False, (213, 94, 0), 2, cv2.LINE_AA)
  for goal in goals:
    cv2.drawMarker(picture, pixel(goal), (0, 114, 178), cv2.MARKER_TILTED_CROSS, 24, 4)
  return picture
