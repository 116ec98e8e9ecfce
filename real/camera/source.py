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


def check_shape(picture: np.ndarray, size: tuple[int, int]) -> None:
  """Raises ValueError where pictures [H, W, 3] have another shape than (height, width) of a policy.

  A lens is calibrated for one shape.
  """
  if len(size) != 2 or min(size) < 1:
    raise ValueError(f"A camera's size is (height, width) in pixels, found {size!r}.")
  height, width = picture.shape[:2]
  # Half a pixel of the small picture is what rounding explains.
  if abs(width * size[0] / height - size[1]) > 0.5:
    raise ValueError(
      f"The camera gives {width} x {height} pixels, which do not shrink to {size[1]} x {size[0]}: "
      "give another camera, stream or file, of that shape, or a policy with pictures of this shape "
      "(in Python a device is asked for one by CaptureSettings.capture_size)."
    )


def resize(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
  """Returns a picture [H, W, 3] in another size (height, width): each pixel is the area's mean."""
  height, width = size
  if picture.shape[:2] == (height, width):
    return picture
  return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
