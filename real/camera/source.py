"""Where the robot's pictures come from, and the size that a policy sees them in."""

from typing import Protocol

import cv2
import numpy as np


class CameraSource(Protocol):
  """A camera that keeps its newest picture, such as `real.camera.device.Camera`."""

  def read(self) -> tuple[np.ndarray, float]:
    """Returns the newest picture as it came, RGB uint8 [H, W, 3], and its age [s]; never waits."""

  def close(self) -> None:
    """Frees the camera."""


def resize(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
  """Returns a picture [H, W, 3] in another size (height, width): each pixel is the area's mean."""
  height, width = size
  if picture.shape[:2] == (height, width):
    return picture
  return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
