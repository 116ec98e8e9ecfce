"""Writes and decodes pictures where OpenCV's own functions fail.

Its writer only returns that nothing was written; its reader ends the process at a file's name that
is no UTF-8.
"""

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


def decoded(data: bytes, how: int) -> np.ndarray | None:
  """Decodes what a picture's file holds.

  Args:
    data: The file's content.
    how: One of OpenCV's IMREAD_ flags, or several.

  Returns:
    Pixels [H, W] or [H, W, C], BGR; None where it is damaged or no picture.
  """
  if not data:
    return None
  try:
    return cv2.imdecode(np.frombuffer(data, np.uint8), how)
  except cv2.error:
    return None
