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
  lost = patches.align(model, database, images_folder, report=report)
  left = {image.image_id: image.num_points3D for image in mapping.registered(model)}
  for observation in lost:
    left[observation.image] -= 1
  for observation in lost:
    enough = left[observation.image] >= mapping.MIN_OBSERVATIONS
    if enough and model.images[observation.image].points2D[observation.row].has_point3D():
      model.delete_observation(*observation)
  return model


def settle(
  model: pycolmap.Reconstruction, lens: mapping.FreeLens, *, report: Progress = no_progress
) -> pycolmap.Reconstruction:
  """Returns a model adjusted by a loss, and without observations beyond a limit, of their noise.

  Args:
    model: Adjusted already.
    lens: Which parameters of it are free.
    report: Called with the fraction done and a text.
  """
  model = pycolmap.Reconstruction(model)
  for done in range(_ROUNDS):
    report(done / _ROUNDS, "adjusting poses and lens by the noise that is left")
    model.update_point_3d_errors()
    errors = [point.error for point in model.points3D.values()]
    scale = float(np.clip(_LOSS * np.median(errors), _LEAST_LOSS, mapping.LOSS_SCALE))
    mapping.adjust(model, principal=lens.principal, distortion=lens.distortion, loss=scale)
    mapping.drop_bad_observations(model, limit=mapping.MAX_ERROR * scale / mapping.LOSS_SCALE)
  return model
