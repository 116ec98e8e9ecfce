"""Localised pictures that came with depth, laid onto each other's surfaces.

`refinement.py` adjusts poses to features, and its points tell whether and when a sensor of its own
measured the depth (`sensor.py`). Depth that is aligned with the pictures then tells more: pictures
of plain walls see few points, and all see surfaces. Not so depth of a sensor of its own, which sits
a few millimetres beside where points show it: poses would move by as much.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.scenes.capture.posed import agreement, depth_pictures
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import localisation, mapping
from nerf2real.scenes.poses.depth import matched, refinement, surfaces
from nerf2real.scenes.poses.depth.adjustment import adjust
from nerf2real.scenes.poses.localisation import Localisation

_ADJUSTED = 0.7  # of the progress: when poses are adjusted; the points follow
_CLEARLY = 6.0  # deviations of a scale; chosen: three, as errors near each other are alike
_KEPT = ("registered_fraction", "unit_from_source", "shutter", "warnings", "seconds", "left_out")


def aligned(
  found: Localisation,
  known: KnownPoses,
  images: Sequence[Path],
  database: Path,
  *,
  progress: Progress = no_progress,
) -> tuple[pycolmap.Reconstruction, Localisation, float] | None:
  """Adjusts poses and lens to the depth; None where depth and pictures then agree no better.

  Where the metre of the poses that came is clearly not the sensor's, theirs holds, and the unit of
  the depth changes.

  Args:
    found: The localised pictures.
    known: Poses and depth, aligned with the pictures, as they came; in the order of `found.names`.
    images: The pictures, of the camera's size, in that order.
    database: Their features and verified matches.
    progress: Called with the fraction done and a text.

  Returns:
    A model in the unit frame with the points that the pictures see and the sensor's, what
    `found` is with it, and the factor on the depth's unit.
  """
  names, came = list(found.names), known.world_from_camera
  start = found.unit_from_source.inverse().apply_pose(found.world_from_camera)
  before = known.with_views(found.camera, start)
  poses, camera = adjust(
    start,
    found.camera,
    np.stack([surfaces.cells(depth_pictures.read(f), known.depth_unit) for f in known.depth_files]),
    matched.read_matches(database, names, known.depth_files, known.depth_unit, found.camera),
    refinement.pairs_of(before),
    came=came,
    report=part(progress, 0.0, _ADJUSTED),
  )
  if mapping.camera_fault(camera) or mapping.moved_fault(found.camera, camera):
    return None
  back = _moved_back(poses[:, :3, 3], came[:, :3, 3])
  after = dataclasses.replace(known, depth_unit=known.depth_unit * back.scale)
  after = after.lifted().with_views(camera, back.apply_pose(poses))
  off = agreement.distances([before, after], images)
  if not off[1] < off[0]:
    return None
  progress(_ADJUSTED, f"points of {len(names)} pictures")
  bare = dataclasses.replace(
    after, points=np.zeros((0, 3)), point_colors=np.zeros((0, 3), np.uint8)
  )
  model = mapping.triangulate(database, images[0].parent, bare, names)
  model.update_point_3d_errors()
  model.extract_colors_for_all_images(str(images[0].parent))
  refinement.with_sensor(after, model, names)
  model.transform(pycolmap.Sim3d(found.unit_from_source.matrix))
  words = (
    f"{found.strategy}; then laid onto each other's surfaces, which leaves {off[1]:.1f} pixels in "
    f"place of {off[0]:.1f}"
  )
  values = {name: getattr(found, name) for name in _KEPT}
  values |= {"strategy": words, "reprojection_error_px": localisation.reprojection_error(model)}
  return model, localisation.from_model(model, values), back.scale


def _moved_back(places: np.ndarray, came: np.ndarray) -> Similarity:
  """Returns what moves places [N, 3] onto those that came, with a scale where that is clear."""
  scaled = Similarity.fit(places, came)
  left = np.sqrt(np.mean((scaled.apply(places) - came) ** 2))
  deviation = left / max(np.linalg.norm(came - came.mean(axis=0)), 1e-12)
  if abs(np.log(scaled.scale)) > _CLEARLY * deviation:
    return scaled
  return Similarity.fit(places, came, with_scale=False)
