"""Depth pictures of a sensor: reading, resampling and lifting to rays.

Shapes: A sightings, H height, W width.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.picture_files import decoded
from nerf2real.scenes.capture.media.errors import CaptureError

MILLIMETRE = 1e-3  # m: 7-Scenes', ScanNet's and nerfstudio's depth
_SIGHTINGS = 400  # points lifted from a picture
_INVALID = 65535  # 7-Scenes' value where no depth was measured; 0 is everybody's


def read(path: Path) -> np.ndarray:
  """Reads a depth picture, uint16 [H, W]; what counts as not measured is 0."""
  depth = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED)
  if depth is None or depth.ndim != 2 or depth.dtype != np.uint16:
    found = "nothing readable" if depth is None else f"{depth.dtype} of shape {depth.shape}"
    raise CaptureError(f"{path} is no depth picture: found {found}, expected 16-bit grey.")
  return np.where(depth == _INVALID, 0, depth)


class Readable:
  """Which depth pictures can be read, of those that are asked for."""

  def __init__(self, files: Sequence[Path]):
    self._files = files
    self._asked = 0
    self._lost: list[CaptureError] = []

  def is_sound(self, index: int) -> bool:
    """Whether a picture's depth can be read, or it came without."""
    if not self._files:
      return True
    self._asked += 1
    try:
      read(self._files[index])
    except CaptureError as error:
      self._lost.append(error)
      return False
    return True

  def warnings(self) -> list[str]:
    """Says how many cannot be read.

    Raises:
      CaptureError: Most cannot.
    """
    if not self._lost:
      return []
    words = f"{len(self._lost)} of {self._asked} depth pictures that were tried cannot be read"
    if 2 * len(self._lost) > self._asked:
      raise CaptureError(f"{words}: {self._lost[0]}")
    return [f"{words}: left out with their pictures. {self._lost[0]}"]


def measured_depth(path: Path, unit: float, camera: Camera) -> np.ndarray:
  """Reads a depth picture at a camera's size, the nearest pixel each.

  Args:
    path: 16-bit picture, z-depth in a unit, of the same view as the camera's.
    unit: That unit [m].
    camera: Of the pictures; may be smaller.

  Returns:
    z-depth float32 [H, W] [m]; 0 where nothing was measured.
  """
  depth = read(path)
  row, column = (
    ((np.arange(size) + 0.5) * length / size).astype(int)
    for size, length in zip((camera.height, camera.width), depth.shape, strict=True)
  )
  return (depth[row][:, column] * unit).astype(np.float32)


def seen_from(
  depth: np.ndarray, rays: np.ndarray, other_from_camera: np.ndarray, other: Camera
) -> np.ndarray:
  """Moves a depth picture to where another camera would have measured it.

  Args:
    depth: z-depth [H, W] [m], 0 where nothing was measured.
    rays: Of the pixels of the camera that measured it [H, W, 3], of length 1 along its axis.
    other_from_camera: That camera's pose [4, 4] in the other's frame.
    other: The other camera.

  Returns:
    z-depth float32 of the other's size [m], the nearest where several meet; 0 where nothing was
    measured.
  """
  seen = depth > 0
  points = (rays[seen] * depth[seen][:, None]) @ other_from_camera[:3, :3].T
  points += other_from_camera[:3, 3]
  points = points[points[:, 2] > 0]
  column, row = np.floor(other.project(points)).astype(int).T
  inside = (column >= 0) & (column < other.width) & (row >= 0) & (row < other.height)
  far_first = np.flatnonzero(inside)[np.argsort(-points[inside, 2], kind="stable")]
  result = np.zeros((other.height, other.width), np.float32)
  result[row[far_first], column[far_first]] = points[far_first, 2]
  return result


def at_pixels(path: Path, pixels: np.ndarray, camera: Camera) -> np.ndarray:
  """Reads z-depth float64 [A] at pixels [A, 2] of a camera; 0 where none was measured [unit]."""
  depth = read(path)
  height, width = depth.shape
  column, row = np.floor(pixels * [width / camera.width, height / camera.height]).astype(int).T
  return depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)


def sightings(depth_files: Sequence[Path], unit: float, camera: Camera) -> np.ndarray:
  """Lifts a grid of pixels of depth pictures that are aligned with the colour pictures.

  Args:
    depth_files: 16-bit pictures, z-depth in a unit.
    unit: That unit [m].
    camera: Of the colour pictures, whose pixels the result is in.

  Returns:
    float64 [A, 4]: index of the picture, pixel x and y, distance along the pixel's ray [m].

  Raises:
    CaptureError: A picture cannot be read or shows nothing.
  """
  found = []
  for index, path in enumerate(depth_files):
    depth = read(path)
    height, width = depth.shape
    stride = max(1, int(np.sqrt(width * height / _SIGHTINGS)))
    row, column = (
      axis.ravel() for axis in np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    )
    value = depth[row, column].astype(np.float64)
    good = value > 0
    pixel = np.stack(
      [(column + 0.5) * camera.width / width, (row + 0.5) * camera.height / height], -1
    )[good]
    reach = np.linalg.norm(camera.rays(pixel), axis=-1) * value[good] * unit
    found.append(np.column_stack([np.full(good.sum(), float(index)), pixel, reach]))
  rows = np.concatenate(found)
  if not len(rows):
    raise CaptureError(f"{depth_files[0].parent}: the depth pictures hold no measured pixel.")
  return rows
