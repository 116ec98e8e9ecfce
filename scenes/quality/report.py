"""The report of a scene: what went in, what came out and how good it is, as one HTML page."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import trimesh

from nerf2real.core import palette
from nerf2real.core.floor_map import FloorMap
from nerf2real.core.pages import charts, page, pictures
from nerf2real.core.pages.blocks import (
  Block,
  Details,
  Figure,
  Figures,
  Grid,
  Picture,
  Preformatted,
  Times,
)
from nerf2real.core.pages.page import Section
from nerf2real.scenes.quality import in_short
from nerf2real.scenes.quality.held_out import ViewScore

_THUMBNAILS = 18
_THUMBNAIL_WIDTH = 240
_SHOWN_VIEWS = 5
_SHOWN_ROBOT_VIEWS = 8
_VIEW_WIDTH = 480
_DOT = 0.04  # m, radius of a camera on the map


class Meaning(NamedTuple):
  """The meaning of a figure of scene.json."""

  unit: str
  text: str
  good: str = ""


# Name in scene.json -> its meaning; names that are not here are shown without a text.
FIGURES: Mapping[str, Meaning] = {
  "keyframes": Meaning("", "pictures taken from the capture"),
  "registered_fraction": Meaning("", "share of the keyframes whose pose was found", "1"),
  "reprojection_error_px": Meaning(
    "px", "mean distance between seen and predicted feature positions", "lower"
  ),
  "focal_length_px": Meaning("px", "mean focal length of the capture's camera"),
  "held_out_views": Meaning("", "pictures kept from training, used for the figures of pictures"),
  "held_out_psnr_db": Meaning(
    "dB", "peak signal-to-noise ratio on held-out views, full size, mean", "higher"
  ),
  "held_out_ssim": Meaning(
    "", "structural similarity on held-out views, full size, mean", "near 1"
  ),
  "held_out_psnr_30x40_db": Meaning("dB", "the same views at 30x40", "higher"),
  "exposure_ratio": Meaning(
    "", "brightest to darkest exposure of the capture; it was evened out", "near 1"
  ),
  "corner_light": Meaning(
    "",
    "light in a picture's corner, share of its middle's (vignetting); it was evened out",
    "near 1",
  ),
  "held_out_psnr_60x80_db": Meaning("dB", "the same views at 60x80", "higher"),
  "held_out_ssim_30x40": Meaning("", "the same views at 30x40", "near 1"),
  "held_out_ssim_60x80": Meaning("", "the same views at 60x80", "near 1"),
  "robot_psnr_db": Meaning(
    "dB", "PSNR at 30x40; from the robot's own camera where the truth is known", "higher"
  ),
  "robot_psnr_60x80_db": Meaning("dB", "PSNR at 60x80 from the robot's own camera", "higher"),
  "collision_error_m": Meaning(
    "m", "95th percentile of parts to seen surface and back, the worse", "lower"
  ),
  "sight_lines": Meaning("", "lines from held-out pictures to localised points that judge below"),
  "sight_lines_blocked": Meaning(
    "", "share of them that a part blocks more than 5 cm before the point", "near 0"
  ),
  "sight_lines_blocked_p95_m": Meaning(
    "m", "95th percentile of how far before its point a sight line meets a part", "below 0.1"
  ),
  "points_missed": Meaning("", "share of their points with no part or floor within 5 cm", "near 0"),
  "points_to_parts_p95_m": Meaning(
    "m", "95th percentile of their points' distance from parts or floor", "lower"
  ),
  "collision_parts": Meaning("", "convex parts that MuJoCo collides"),
  "moved_to_floor": Meaning(
    "",
    "share of the field's depth that stood before a floor that the pictures show; it was moved",
    "near 0",
  ),
  "moved_to_planes": Meaning(
    "", "share of the field's depth in plain regions that was put onto what borders them lies on"
  ),
  "floor_tilt_deg": Meaning(
    "deg", "angle between the floor found and the true vertical's floor", "near 0"
  ),
  "floor_tilt_from_cameras_deg": Meaning(
    "deg", "angle between the floor's normal and the cameras' up direction"
  ),
  "floor_height_error_m": Meaning("m", "height of the floor found against the truth", "near 0"),
  "scale_source": Meaning("", "where the metric scale comes from"),
  "scale_spread": Meaning("", "relative standard deviation of the scale", "lower"),
  "marker_place": Meaning("", "what places on the map are measured from in the room"),
  "map_shift_m": Meaning("m", "how far the map's origin is from the truth's", "near 0"),
  "map_turn_deg": Meaning("deg", "how far the map is turned against the truth's", "near 0"),
  "scale_error": Meaning("", "relative error of the scale against the truth", "near 0"),
  "camera_rmse_m": Meaning(
    "m", "RMSE of the camera positions against the truth after alignment", "lower"
  ),
  "camera_rotation_deg": Meaning("deg", "RMSE of the camera rotations against the truth", "lower"),
  "collision_true_p95_m": Meaning(
    "m", "95th percentile of the parts' distance from the true surface", "lower"
  ),
  "collision_true_within_5cm": Meaning(
    "", "share of the touchable collision surface within 5 cm of the true surface", "near 1"
  ),
  "surface_true_p95_m": Meaning(
    "m", "95th percentile of the true surface's distance from the parts", "lower"
  ),
  "surface_true_within_5cm": Meaning(
    "", "share of the true surface within 5 cm of the parts", "near 1"
  ),
  "sight_lines_blocked_by_truth": Meaning(
    "", "the same share of sight lines, judged on the true surface: the judge's own error", "near 0"
  ),
  "sight_lines_blocked_by_truth_p95_m": Meaning(
    "m", "95th percentile of how far before its point a sight line meets the true surface", "near 0"
  ),
  "points_missed_by_truth": Meaning(
    "", "the same share of points, judged on the true surface: the judge's own error", "near 0"
  ),
  "free_area_m2": Meaning("m^2", "largest piece of floor that the robot can walk about on"),
  "free_area_apart_m2": Meaning(
    "m^2", "floor where it fits, too, behind passages that are too narrow for it", "near 0"
  ),
  "passage_lacks_m": Meaning(
    "m", "width that the widest way to the largest such piece lacks for the robot"
  ),
  "baseline_psnr_db": Meaning("dB", "PSNR of the COLMAP Poisson mesh on the same held-out views"),
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
  strategy: str
  """How the keyframes were matched."""
  cameras: np.ndarray
  """Places of the pictures [N, 3]."""
  filmed: bool
  """Whether they follow each other on a path."""
  views: Sequence[ViewScore]
  """held-out views at full size."""
  robot_views: Sequence[ViewScore]
  """At robot resolution."""
  baseline: Mapping[str, np.ndarray]
  """Name of a held-out view -> baseline's picture; may be empty."""
  visual: trimesh.Trimesh
  collision: Sequence[trimesh.Trimesh]
  floor: FloorMap
  """Without goals and cameras."""
  goals: np.ndarray
  """[G, 2]."""
  names: Mapping[str, str] = dataclasses.field(default_factory=dict)
  """Name of a keyframe's file -> of the file that whoever took it knows."""

  def called(self, name: str) -> str:
    """What a view is called in the report."""
    return self.names.get(name, name)


def write(path: Path, data: ReportData) -> None:
  """Writes the page as one file that opens offline."""
  sections = [
    in_short.section(data.figures),
    _views(data),
    *([_robot_views(data)] if data.robot_views else []),
    *_geometry(data),
    _free_space(data),
    _keyframes(data),
    Section("Figures", "", [_figures(data.figures)]),
    Section("Time", "Wall-clock time of each stage.", [Times(data.seconds)]),
    Section(
      "Settings",
      "",
      [Details("all settings", [Preformatted(json.dumps(data.settings, indent=1))])],
    ),
  ]
  origin = page.Origin.of_process()
  page.write(path, page.Page(data.title, data.lead, sections, data.warnings, origin))


def _figures(values: Mapping[str, Any]) -> Figures:
  return Figures(
    [
      Figure(name, value, *FIGURES.get(name, ()))
      for name, value in values.items()
      if value is not None and not isinstance(value, Mapping)
    ]
  )


def _keyframes(data: ReportData) -> Section:
  chosen = np.unique(np.linspace(0, len(data.keyframes) - 1, _THUMBNAILS).astype(int))
  cells = []
  for file in (data.keyframes[index] for index in chosen):
    image: Any = cv2.imread(str(file))
    small = pictures.shrink(image[..., ::-1], _THUMBNAIL_WIDTH)
    cells.append(Picture(small, data.called(file.name)))
  return Section(
    "Keyframes", f"{len(data.keyframes)} keyframes; {data.strategy}.", [Grid(cells, 6)]
  )


def _views(data: ReportData) -> Section:
  """Shows the best, the worst and some views between, so that failures are seen."""
  order = sorted(data.views, key=lambda view: view.psnr_db)
  chosen = np.unique(np.linspace(0, len(order) - 1, _SHOWN_VIEWS).astype(int))
  cells: list[Block] = []
  for view in (order[index] for index in chosen):
    shown = [
      (view.truth, f"{data.called(view.name)}: picture"),
      (view.image, f"field: {view.psnr_db:.1f} dB, SSIM {view.ssim:.3f}"),
      (pictures.error_map(view.truth, view.image), "error (white: 64 of 255)"),
      (pictures.depth_map(view.depth), "depth (near is red)"),
    ]
    if data.baseline:
      shown.append((data.baseline[view.name], "COLMAP Poisson mesh"))
    cells += [Picture(pictures.shrink(image, _VIEW_WIDTH), text) for image, text in shown]
  return Section(
    "Held-out views",
    "Pictures that training never saw, from the worst to the best.",
    [Grid(cells, 5 if data.baseline else 4)],
  )


def _robot_views(data: ReportData) -> Section:
  cells: list[Block] = []
  for view in data.robot_views[:_SHOWN_ROBOT_VIEWS]:
    cells += [
      Picture(view.truth, f"{data.called(view.name)}: truth", pixelated=True),
      Picture(view.image, f"field: {view.psnr_db:.1f} dB", pixelated=True),
    ]
  height, width = data.robot_views[0].truth.shape[:2]
  return Section(
    f"At the robot's resolution ({height}x{width})",
    "What the policy would see beside the same picture averaged over its pixels.",
    [Grid(cells, 4)],
  )


def _geometry(data: ReportData) -> list[Section]:
  cameras = charts.path_trace(data.cameras, joined=data.filmed)
  surface = [charts.mesh_trace(data.visual, name="surface"), cameras]
  convex = [
    charts.mesh_trace(part, color=palette.cycle(index), name=f"part {index}")
    for index, part in enumerate(data.collision)
  ]
  return [
    Section(
      "Surface and cameras",
      "Drag to turn, scroll to zoom.",
      [charts.figure_3d(surface)],
    ),
    Section(
      "Contact geometry",
      f"{len(data.collision)} convex parts as MuJoCo collides them; the floor is a plane at z = 0.",
      [charts.figure_3d(convex)],
    ),
  ]


def _free_space(data: ReportData) -> Section:
  floor, color = data.floor.copy(), palette.rgb(palette.VERMILION)
  if data.filmed:
    floor.path(data.cameras, color)
  else:
    for place in data.cameras:
      floor.disc(place[:2], _DOT, color)
  for goal in data.goals:
    floor.cross(goal, palette.rgb(palette.BLUE))
  return Section(
    "Free space",
    "Seen from above: white is floor that the robot's centre may stand on, light grey is too near "
    "to something or cut off, grey was never seen, dark grey is occupied. Crosses are the goals, "
    f"the {'line is the camera' if data.filmed else 'dots are the cameras'}.",
    [Grid([Picture(floor.scale_bar().picture)], 2)],
  )
