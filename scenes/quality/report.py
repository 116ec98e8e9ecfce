"""The report of a scene: what went in, what came out and how good it is, as one HTML page."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from nerf2real.core import files
from nerf2real.core.pages import parts
from nerf2real.scenes.quality.held_out import ViewScore

_THUMBNAILS = 18
_THUMBNAIL_WIDTH = 240
_SHOWN_VIEWS = 5
_VIEW_WIDTH = 480

# name in scene.json -> (unit, what it means); names that are not here are shown without a text
FIGURES: Mapping[str, tuple[str, str]] = {
  "keyframes": ("", "pictures taken from the capture"),
  "registered_fraction": ("", "share of the keyframes whose pose was found"),
  "reprojection_error_px": ("px", "mean distance between seen and predicted feature positions"),
  "focal_length_px": ("px", "mean focal length of the capture's camera"),
  "held_out_views": ("", "pictures kept from training, used for the figures below"),
  "held_out_psnr_db": ("dB", "peak signal-to-noise ratio on held-out views, full size, mean"),
  "held_out_ssim": ("", "structural similarity on held-out views, full size, mean"),
  "held_out_psnr_30x40_db": ("dB", "the same views at 30x40"),
  "exposure_ratio": ("", "brightest to darkest exposure of the capture; it was evened out"),
  "held_out_psnr_60x80_db": ("dB", "the same views at 60x80"),
  "held_out_ssim_30x40": ("", "the same views at 30x40"),
  "held_out_ssim_60x80": ("", "the same views at 60x80"),
  "robot_psnr_db": ("dB", "PSNR at 30x40; from the robot's own camera where the truth is known"),
  "robot_psnr_60x80_db": ("dB", "PSNR at 60x80 from the robot's own camera"),
  "collision_error_m": ("m", "95th percentile of parts to seen surface and back, the worse"),
  "collision_parts": ("", "convex parts that MuJoCo collides"),
  "floor_tilt_deg": ("deg", "angle between the floor found and the true vertical's floor"),
  "scale_source": ("", "where the metric scale comes from"),
  "scale_error": ("", "relative error of the scale against the truth"),
  "camera_rmse_m": ("m", "RMSE of the camera positions against the truth after alignment"),
  "free_area_m2": ("m^2", "floor area that the robot can stand on"),
  "baseline_psnr_db": ("dB", "PSNR of the COLMAP Poisson mesh on the same held-out views"),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportData:
  """What a report shows; everything in the world frame."""

  title: str
  lead: str
  figures: Mapping[str, Any]
  seconds: Mapping[str, float]
  warnings: Sequence[str]
  settings: Mapping[str, Any]
  keyframes: Sequence[Path]
  strategy: str  # how the keyframes were matched
  camera_path: np.ndarray  # [N, 3]
  views: Sequence[ViewScore]  # held-out views at full size
  robot_views: Sequence[ViewScore]  # at robot resolution
  baseline: Mapping[str, np.ndarray]  # name of a held-out view -> baseline's picture; may be empty
  visual: trimesh.Trimesh
  collision: Sequence[trimesh.Trimesh]
  free_space_picture: np.ndarray  # uint8 [H, W, 3], top-down with goals and camera path


def write(path: Path, data: ReportData) -> None:
  """Writes the page as one file that opens offline."""
  sections = [
    _summary(data),
    _keyframes(data),
    _views(data),
    _robot_views(data),
    _geometry(data),
    parts.section(
      "Free space",
      "Seen from above: white is floor that the robot's centre may stand on, grey is too near to "
      "something, black is occupied or never seen. Crosses are the goals, the line is the camera.",
      parts.grid([parts.picture(data.free_space_picture)], 2),
    ),
    parts.section("Time", "Wall-clock time of each stage.", parts.times(data.seconds)),
    parts.section(
      "Settings", "", parts.details("all settings", json.dumps(data.settings, indent=1))
    ),
  ]
  files.write_atomically(path, parts.page(data.title, data.lead, sections, with_plots=True))


def _summary(data: ReportData) -> str:
  rows = []
  for name, value in data.figures.items():
    if value is None or isinstance(value, Mapping):
      continue
    unit, text = FIGURES.get(name, ("", ""))
    rows.append((name, value, unit, text))
  return parts.section(
    "Figures",
    "",
    parts.warnings(data.warnings),
    parts.table(("figure", "value", "unit", "meaning"), rows),
  )


def _keyframes(data: ReportData) -> str:
  chosen = np.unique(np.linspace(0, len(data.keyframes) - 1, _THUMBNAILS).astype(int))
  pictures = []
  for index in chosen:
    image: Any = cv2.imread(str(data.keyframes[index]))
    height = round(image.shape[0] * _THUMBNAIL_WIDTH / image.shape[1])
    image = cv2.resize(image, (_THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
    pictures.append(parts.picture(image[..., ::-1], data.keyframes[index].stem))
  text = f"{len(data.keyframes)} keyframes; {data.strategy}."
  return parts.section("Keyframes", text, parts.grid(pictures, 6))


def _shrink(image: np.ndarray) -> np.ndarray:
  height = round(image.shape[0] * _VIEW_WIDTH / image.shape[1])
  if image.shape[1] <= _VIEW_WIDTH:
    return image
  return cv2.resize(image, (_VIEW_WIDTH, height), interpolation=cv2.INTER_AREA)


def _views(data: ReportData) -> str:
  """Shows the best, the worst and some views between, so that failures are seen."""
  order = sorted(range(len(data.views)), key=lambda k: data.views[k].psnr_db)
  chosen = [order[k] for k in np.unique(np.linspace(0, len(order) - 1, _SHOWN_VIEWS).astype(int))]
  cells = []
  columns = 5 if data.baseline else 4
  for index in chosen:
    view = data.views[index]
    cells += [
      parts.picture(_shrink(view.truth), f"{view.name}: picture"),
      parts.picture(_shrink(view.image), f"field: {view.psnr_db:.1f} dB, SSIM {view.ssim:.3f}"),
      parts.picture(_shrink(parts.error_map(view.truth, view.image)), "error (white: 64 of 255)"),
      parts.picture(_shrink(parts.depth_map(view.depth)), "depth (near is red)"),
    ]
    if data.baseline:
      cells.append(parts.picture(_shrink(data.baseline[view.name]), "COLMAP Poisson mesh"))
  return parts.section(
    "Held-out views",
    "Pictures that training never saw, from the worst to the best.",
    parts.grid(cells, columns),
  )


def _robot_views(data: ReportData) -> str:
  if not data.robot_views:
    return ""
  cells = []
  for view in data.robot_views[:8]:
    cells += [
      parts.picture(view.truth, f"{view.name}: truth", pixelated=True),
      parts.picture(view.image, f"field: {view.psnr_db:.1f} dB", pixelated=True),
    ]
  height, width = data.robot_views[0].truth.shape[:2]
  return parts.section(
    f"At the robot's resolution ({height}x{width})",
    "What the policy would see beside the same picture averaged over its pixels.",
    parts.grid(cells, 4),
  )


def _geometry(data: ReportData) -> str:
  surface = parts.figure_3d(
    [parts.mesh_trace(data.visual, name="surface"), parts.path_trace(data.camera_path)]
  )
  convex = parts.figure_3d(
    [
      parts.mesh_trace(part, color=parts.part_color(index), name=f"part {index}")
      for index, part in enumerate(data.collision)
    ]
  )
  return parts.section(
    "Surface and camera path", "Drag to turn, scroll to zoom.", surface
  ) + parts.section(
    "Contact geometry",
    f"{len(data.collision)} convex parts as MuJoCo collides them; the floor is a plane at z = 0.",
    convex,
  )
