"""Finds pictures whose place hangs on too little.

A picture of a plain wall may be held to the others by one small thing, such as a poster: turned
about it by degrees all matches still agree, and where two such things are alike it may hang on the
wrong one without a contradiction. The covariance of the adjustment of all places and points shows
it, as such a place is known several times less well than the others are.
"""

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.mapping import registered

_TIMES = 5.0  # the median deviation, beyond which a place is not used, chosen on four drawn rooms


def turns(model: pycolmap.Reconstruction) -> dict[int, float]:
  """Standard deviations of the pictures' rotations [rad] by their ids, for 1 pixel of noise.

  A picture that holds the frame may have none; empty where the adjustment is singular.

  Args:
    model: Adjusted poses and points.
  """
  model = pycolmap.Reconstruction(model)
  model.tear_down()  # pictures without a pose, which the covariance cannot have
  options = pycolmap.BundleAdjustmentOptions()
  options.print_summary = False
  config = pycolmap.BundleAdjustmentConfig()
  for image in registered(model):
    config.add_image(image.image_id)
  config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
  adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
  wanted = pycolmap.BACovarianceOptions()
  wanted.params = pycolmap.BACovarianceOptionsParams.POSES
  found = pycolmap.estimate_ba_covariance(wanted, model, adjuster)
  if found is None:
    return {}
  covariances = {i.image_id: found.get_cam_cov_from_world(i.image_id) for i in registered(model)}
  return {k: float(np.sqrt(np.trace(c[:3, :3]))) for k, c in covariances.items() if c is not None}


def drop_uncertain(
  model: pycolmap.Reconstruction, *, least: int = 0
) -> tuple[list[str], list[str]]:
  """Takes the pose from pictures whose place hangs on too little, the least certain first.

  Args:
    model: Adjusted poses and points; changed in place.
    least: So many pictures keep their poses, certain or not.

  Returns:
    Names of those that have lost their pose, and of those that kept it though uncertain.
  """
  deviations = turns(model)
  usual = np.median(list(deviations.values())) if deviations else 0.0
  uncertain = [key for key, deviation in deviations.items() if deviation > _TIMES * usual]
  uncertain.sort(key=lambda key: -deviations[key])
  spare = max(model.num_reg_images() - least, 0)
  for key in uncertain[:spare]:
    model.deregister_frame(model.images[key].frame_id)
  names = [model.images[key].name for key in uncertain]
  return names[:spare], names[spare:]
