"""A posed sequence of pictures and depth pictures, whatever its layout on disk.

Shapes: N pictures.
"""

import dataclasses
from pathlib import Path

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import intrinsics

_NOMINAL = (640, 480)  # picture size of the data sets' nominal cameras [pixel]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
  """Pictures with their poses and measured depth."""

  files: list[Path]
  """Pictures."""
  poses: np.ndarray
  """World from camera [N, 4, 4], OpenCV camera axes [m]."""
  depth: list[Path]
  """Depth pictures: none, or one each."""
  unit: float
  """Of the depth pictures [m]."""
  depth_poses: np.ndarray | None = None
  """Poses [N, 4, 4] when the depth was measured; None: when the pictures were taken."""
  camera: Camera | None = None
  """Of the pictures; None until it is known."""
  warnings: tuple[str, ...] = ()
  """What was left out or assumed."""

  def selected(self, rows: np.ndarray) -> "Recording":
    """Keeps some of the pictures."""
    return dataclasses.replace(
      self,
      files=[self.files[k] for k in rows],
      poses=self.poses[rows],
      depth=[self.depth[k] for k in rows] if self.depth else [],
      depth_poses=None if self.depth_poses is None else self.depth_poses[rows],
    )

  def warned(self, text: str) -> "Recording":
    """Adds a warning."""
    return dataclasses.replace(self, warnings=(*self.warnings, text))

  def placed(self, source: Path) -> "Recording":
    """Leaves out the pictures whose pose is not finite, as trackers write of lost frames.

    Raises:
      CaptureError: None has a pose.
    """
    finite = np.isfinite(self.poses).all((1, 2))
    if finite.all():
      return self
    if not finite.any():
      raise CaptureError(f"{source} holds no finite pose: expected one for each picture.")
    words = f"{(~finite).sum()} of {len(finite)} poses are lost: left out."
    return self.selected(np.flatnonzero(finite)).warned(words)

  def present(self, source: Path) -> "Recording":
    """Leaves out the pictures whose files are missing, and all depth where most of it is.

    Raises:
      CaptureError: Most pictures are missing.
    """
    found = self
    sensed = [path.is_file() for path in self.depth]
    if self.depth and 2 * sum(sensed) < len(sensed):
      words = f"{len(sensed) - sum(sensed)} of {len(sensed)} depth pictures are missing: none used."
      found, sensed = dataclasses.replace(self, depth=[], depth_poses=None).warned(words), []
    there = np.array([path.is_file() for path in self.files])
    if 2 * there.sum() < len(there):
      missing = self.files[int(np.argmin(there))].name
      raise CaptureError(
        f"{source}: {(~there).sum()} of {len(there)} pictures are missing, as {missing}: copy the "
        "sequence again."
      )
    whole = there & np.array(sensed) if sensed else there
    if not whole.all():
      words = f"{(~whole).sum()} of {len(whole)} pictures or their depth are missing: left out."
      found = found.selected(np.flatnonzero(whole)).warned(words)
    return found


def camera_of(found: Recording, source: Path, *, focal: float, what: str) -> Recording:
  """Adds the camera that lies beside a sequence, or the nominal one of its data set.

  Args:
    found: The pictures.
    source: Folder of the sequence.
    focal: Focal length of the nominal camera, for pictures of 640x480 [pixel].
    what: Whose camera that is.

  Raises:
    CaptureError: No camera is there and the pictures are no nominal camera's.
  """
  camera = intrinsics.given_camera(source, found.files[0])
  if camera is not None:
    return dataclasses.replace(found, camera=camera)
  size = intrinsics.picture_size(found.files[0])
  if size != _NOMINAL:
    raise CaptureError(
      f"{source} says nothing of its camera, and its pictures are {size[0]}x{size[1]}, not "
      f"{what} 640x480: add {intrinsics.CAMERA_INFO} (ROS) or intrinsics.txt (fx fy cx cy)."
    )
  nominal = Camera(
    width=size[0], height=size[1], fx=focal, fy=focal, cx=size[0] / 2, cy=size[1] / 2
  )
  words = (
    f"No {intrinsics.CAMERA_INFO} or intrinsics.txt in the sequence: {what} nominal camera was "
    f"assumed, of {focal:g} pixels."
  )
  return dataclasses.replace(found, camera=nominal).warned(words)
