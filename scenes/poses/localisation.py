"""Camera, poses and points of a capture, and their folder: a COLMAP model with its figures.

Shapes: N registered keyframes, P points.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain, write_json
from nerf2real.scenes.capture.posed.colmap_model import camera_of
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.film.shutter import Shutter
from nerf2real.scenes.poses.tracks import Tracks

_FIGURES = "localisation.json"
# Of points that may be wrong; chosen, not tuned:
_MOST_ERROR = 2.0  # a larger reprojection error [pixel]
_FEWEST_VIEWS = 3  # or fewer pictures: the third one checks the first two


class LocalisationError(ValueError):
  """The keyframes do not connect; the message holds how many did, why, and what to film."""

  missing: frozenset[str] = frozenset()
  """Keyframes that have no place."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Localisation:
  """Where the keyframes were taken, in the unit frame."""

  camera: Camera
  """The one camera of all keyframes."""
  names: tuple[str, ...]
  """Registered keyframes, sorted."""
  world_from_camera: np.ndarray
  """float64 [N, 4, 4], unit frame, OpenCV camera axes."""
  points: np.ndarray
  """float64 [P, 3], unit frame."""
  point_colors: np.ndarray
  """uint8 [P, 3]."""
  point_errors: np.ndarray
  """Mean reprojection error of each point [P] [pixel]."""
  reprojection_error_px: float
  """Mean over the observations [pixel]; NaN where none are known."""
  registered_fraction: float
  """Registered keyframes of all given."""
  strategy: str
  """Which pairs were matched and which mapper was used."""
  unit_from_source: Similarity
  """From the source's frame (COLMAP's, or that of the known poses)."""
  tracks: Tracks
  """Which keyframes see which points."""
  shutter: Shutter | None = None
  """Motion while a picture was read, unit frame; None where all lines count as read at once."""
  warnings: tuple[str, ...] = ()
  """What may ruin the reconstruction."""
  left_out: tuple[str, ...] = ()
  """Keyframes without a place, as theirs hung on little or, of a film, contradicted what was filmed
  moments before and after."""
  seconds: dict[str, float] = dataclasses.field(default_factory=dict)
  """Wall time of each step."""

  def overlooking(self) -> int:
    """Row of the keyframe with the most points before its lens: where a viewer should begin.

    From where nothing was filmed a field is fog.
    """
    from_world = np.linalg.inv(self.world_from_camera)
    edge = np.array([self.camera.width / self.camera.fx, self.camera.height / self.camera.fy]) / 2
    counts = []
    for rotation, offset in zip(from_world[:, :3, :3], from_world[:, :3, 3], strict=True):
      x, y, z = rotation @ self.points.T + offset[:, None]
      counts.append(((z > 0) & (abs(x) < edge[0] * z) & (abs(y) < edge[1] * z)).sum())
    return int(np.argmax(counts))

  def read_picture(self, keyframes: Path, index: int) -> np.ndarray:
    """Reads a keyframe as if all lines were read at once: BGR uint8 [H, W, 3].

    Args:
      keyframes: Folder of the keyframes.
      index: Row of `names`.

    Raises:
      ValueError: The keyframe is damaged.
    """
    path = keyframes / self.names[index]
    image = cv2.imread(str(path))
    if image is None:
      raise ValueError(f"The keyframe {path} cannot be read: delete {path.parent.parent}.")
    return image if self.shutter is None else self.shutter.rectify(image, self.camera, index)


def sure_tracks(found: Localisation) -> Tracks:
  """Returns the observations of points that are hardly wrong."""
  often = found.tracks.lengths(len(found.points)) >= _FEWEST_VIEWS
  return found.tracks.of_points(often & (found.point_errors < _MOST_ERROR))


def reprojection_error(model: pycolmap.Reconstruction) -> float:
  """Mean over the observations [pixel]; over the points where there are no observations."""
  points = list(model.points3D.values())
  points = [point for point in points if point.track.length()] or points
  if not points:
    return float("nan")
  weights = np.array([max(p.track.length(), 1) for p in points])
  return float(np.average([p.error for p in points], weights=weights))


def poses_of(images: list[pycolmap.Image]) -> np.ndarray:
  """World-from-camera poses [N, 4, 4]."""
  poses = np.tile(np.eye(4), (len(images), 1, 1))
  for row, image in enumerate(images):
    poses[row, :3] = image.cam_from_world().inverse().matrix()
  return poses


def from_model(model: pycolmap.Reconstruction, values: dict[str, Any]) -> Localisation:
  """Returns the camera, poses, points and tracks of a COLMAP model, with the figures given."""
  images = mapping.registered(model)
  points = list(model.points3D.values())
  return Localisation(
    camera=camera_of(model),
    names=tuple(image.name for image in images),
    world_from_camera=poses_of(images),
    points=np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
    point_colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    point_errors=np.array([p.error for p in points], np.float64),
    tracks=Tracks.of_model(model, images),
    **values,
  )


def save(model: pycolmap.Reconstruction, localisation: Localisation, folder: Path) -> None:
  """Writes the model and its figures; the folder appears whole or not at all."""
  figures = {
    "registered_fraction": localisation.registered_fraction,
    "reprojection_error_px": localisation.reprojection_error_px,
    "strategy": localisation.strategy,
    "unit_from_source": localisation.unit_from_source,
    "shutter": localisation.shutter,
    "warnings": localisation.warnings,
    "left_out": localisation.left_out,
    "seconds": localisation.seconds,
  }
  with files.atomic_folder(folder) as partial:
    model.write(str(partial))
    write_json(partial / _FIGURES, figures, indent=2)


def load(folder: Path) -> Localisation:
  """Reads what `localise` wrote into `sfm/`.

  Raises:
    LocalisationError: If the folder holds no localisation.
  """
  folder = Path(folder)
  try:
    values = json.loads((folder / _FIGURES).read_text())
    model = pycolmap.Reconstruction(str(folder))
  except (OSError, ValueError, RuntimeError) as error:
    raise LocalisationError(f"{folder} holds no localisation: {error}") from error
  values["unit_from_source"] = from_plain(values["unit_from_source"], Similarity)
  if values.get("shutter") is not None:
    values["shutter"] = from_plain(values["shutter"], Shutter)
  for name in ("warnings", "left_out"):
    values[name] = tuple(values.get(name, ()))
  return from_model(model, values)
