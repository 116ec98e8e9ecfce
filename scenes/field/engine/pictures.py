"""Training pictures, their blurred copies and poses, laid out for the kernels."""

import numpy as np
import warp as wp

from nerf2real.scenes.field.anchors import empty_cells
from nerf2real.scenes.field.engine import layout
from nerf2real.scenes.field.engine.device import Device
from nerf2real.scenes.field.views import BlurPyramid, Views


def upload(views: Views, device: Device, *, blur_max: float) -> layout.Pictures:
  """Copies pictures to a device, blurred up to a standard deviation of `blur_max` [pixel]."""
  pyramid = BlurPyramid.build(views, blur_max=blur_max)
  sizes = [level.size for level in pyramid.levels]
  pictures = layout.Pictures()
  pictures.pixels = device.put(np.concatenate([level.ravel() for level in pyramid.levels]))
  pictures.starts = device.put(np.array([0, *np.cumsum(sizes)[:-1]], np.int32))
  pictures.heights = device.put(np.array([level.shape[1] for level in pyramid.levels], np.int32))
  pictures.widths = device.put(np.array([level.shape[2] for level in pyramid.levels], np.int32))
  pictures.factors = device.put(np.array(pyramid.factors, np.float32))
  pictures.blurs = device.put(np.array(pyramid.blurs, np.float32))
  poses = views.world_from_camera.astype(np.float32)
  pictures.directions = device.put(views.camera.rays().astype(np.float32).reshape(-1, 3), wp.vec3)
  pictures.rotations = device.put(np.ascontiguousarray(poses[:, :3, :3]), wp.mat33)
  pictures.origins = device.put(np.ascontiguousarray(poses[:, :3, 3]), wp.vec3)
  pictures.anchors = device.put(views.anchors.astype(np.float32).reshape(-1, 4), wp.vec4)
  pictures.empty = device.put(empty_cells(views).astype(np.int32))
  return pictures
