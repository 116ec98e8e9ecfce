"""Writes pictures: raises where nothing was written, which OpenCV's own writer only returns."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from nerf2real.core import files


def write_picture(path: Path, image: np.ndarray, parameters: Sequence[int] = ()) -> None:
  """Writes a picture in the format of its suffix.

  Args:
    path: Where to.
    image: BGR [H, W, 3] or grey [H, W].
    parameters: Of the format, pairs of OpenCV's IMWRITE_ names and values.

  Raises:
    DiskFullError: The disk or the quota is exhausted.
    OSError: The file cannot be written.
    ValueError: The suffix is no picture's, or the picture cannot be kept in it.
  """
  try:
    done, content = cv2.imencode(path.suffix, image, list(parameters))
  except cv2.error:
    done = False
  if not done:
    raise ValueError(f"{path} cannot hold a picture {image.dtype} {list(image.shape)}: give .png.")
  with files.explain_disk_full(path):
    path.write_bytes(content.tobytes())
