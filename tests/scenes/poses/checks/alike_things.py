"""A wrong place that a mapper might give a picture of one of two things alike."""

import numpy as np
import pycolmap

from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.mapping import registered
from tests.scenes import synthetic_capture as synthetic


def mistake(model, database, image, *, joined=True):
  """Moves a picture of the first of two alike to before the second, with what it sees of it.

  Where it is not joined, what it sees of it is no point.
  """
  for k, point in enumerate(image.points2D):
    if point.has_point3D():
      model.delete_observation(image.image_id, k)
  second = [i.image_id for i in registered(model)[6:]]
  for ids, matches, points in agreement.matched_points(model, database) if joined else ():
    if image.image_id in ids and set(ids) & set(second):
      own = ids.index(image.image_id)
      for feature, point in zip(matches[:, own], points[:, 1 - own], strict=True):
        if point and not image.points2D[feature].has_point3D():
          model.add_observation(point, pycolmap.TrackElement(image.image_id, int(feature)))
  move = np.linalg.inv(synthetic.FIRST_FROM_SECOND)
  pose = move @ np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
  image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
  return image
