"""Makes a finished model as exact as its pictures allow.

Detected features have half a pixel of noise. Patches aligned between pictures have a tenth, which
poses and lens only take from them when the loss and the limit of an adjustment are of that size.
"""

from pathlib import Path

import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.matching import patches
from nerf2real.scenes.poses.matching.patches import Observation

_LOSS = 2.0  # the loss's scale, times the median error, as it is of detected features
_LEAST_LOSS = 0.05  # [pixel]: no picture is more exact
_ROUNDS = 3  # of adjusting; the errors have settled by then


def align(
  model: pycolmap.Reconstruction,
  database: Path,
  images_folder: Path,
  *,
  report: Progress = no_progress,
) -> pycolmap.Reconstruction:
  """Returns a model whose observations lie where patches of its pictures agree.

  Observations that were not found to lie exactly anywhere go, but those of pictures that would be
  left with too few. Poses and points are not adjusted yet.

  Args:
    model: Poses, and points as they were detected.
    database: With the features of its pictures.
    images_folder: Where the pictures lie.
    report: Called with the fraction done and a text.

  Raises:
    ValueError: A picture cannot be read.
  """
  model = pycolmap.Reconstruction(model)
  _drop(model, patches.align(model, database, images_folder, report=report))
  return model


def _drop(model: pycolmap.Reconstruction, observations: list[Observation]) -> None:
  """Drops observations, but those of pictures that would be left with too few.

  A point that two pictures see is lost to the other one, too.
  """
  left = {image.image_id: image.num_points3D for image in mapping.registered(model)}
  for observation in observations:
    left[observation.image] -= 1
  for image, row in observations:
    place = model.images[image].points2D[row]
    if left[image] < mapping.MIN_OBSERVATIONS or not place.has_point3D():  # it may be gone
      continue
    seen_by = [element.image_id for element in model.points3D[place.point3D_id].track.elements]
    if len(seen_by) == 2:
      other = seen_by[1] if seen_by[0] == image else seen_by[0]
      if left[other] <= mapping.MIN_OBSERVATIONS:
        continue
      left[other] -= 1
    model.delete_observation(image, row)


def _errors(model: pycolmap.Reconstruction) -> tuple[list[Observation], np.ndarray]:
  """All observations [O] and their distances [O] from where their points are [pixel]."""
  observations, errors = [], [np.zeros(0)]
  for image in mapping.registered(model):
    seen = {row: place for row, place in enumerate(image.points2D) if place.has_point3D()}
    if seen:
      points = np.array([model.points3D[place.point3D_id].xyz for place in seen.values()])
      local = image.cam_from_world() * points
      shown = np.asarray(model.cameras[image.camera_id].img_from_cam(local))
      error = np.linalg.norm(shown - [place.xy for place in seen.values()], axis=1)
      errors.append(np.where(local[:, 2] > 0, error, np.inf))
      observations += [Observation(image.image_id, row) for row in seen]
  return observations, np.concatenate(errors)


def settle(
  model: pycolmap.Reconstruction, lens: mapping.FreeLens, *, report: Progress = no_progress
) -> pycolmap.Reconstruction:
  """Returns a model adjusted by a loss, and without observations beyond a limit, of their noise.

  Pictures that would be left with too few observations keep theirs.

  Args:
    model: Adjusted already.
    lens: Which parameters of it are free.
    report: Called with the fraction done and a text.
  """
  model = pycolmap.Reconstruction(model)
  for done in range(_ROUNDS):
    report(done / _ROUNDS, "adjusting poses and lens by the noise that is left")
    usual = float(np.median(_errors(model)[1]))
    scale = float(np.clip(_LOSS * usual, _LEAST_LOSS, mapping.LOSS_SCALE))
    mapping.adjust(model, principal=lens.principal, distortion=lens.distortion, loss=scale)
    limit = mapping.MAX_ERROR * scale / mapping.LOSS_SCALE
    observations, errors = _errors(model)
    _drop(model, [observations[k] for k in np.flatnonzero(errors > limit)])
    mapping.drop_bad_observations(model)
  return model
