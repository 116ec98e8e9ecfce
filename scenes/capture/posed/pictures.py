"""Reads pictures as their known cameras have them."""

from pathlib import Path

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.media import stills


def read_as_posed(path: Path, camera: Camera, *, least: int | None = None) -> np.ndarray:
  """Reads a picture as BGR uint8 [H, W, 3] with its pixels where its camera has them.

  COLMAP, nerfstudio and depth cameras know the pixels as stored: EXIF turns a picture only where
  the stored one is wide and the camera's is upright, or the other way round.

  Args:
    path: The picture.
    camera: Its camera, of any size.
    least: Long side that is needed [pixel]; the picture's own if None.

  Raises:
    CaptureError: It is damaged or no picture.
  """
  image = stills.read_still(path, least=least, upright=False)
  if (image.shape[1] > image.shape[0]) == (camera.width > camera.height):
    return image
  return stills.read_still(path, least=least)
