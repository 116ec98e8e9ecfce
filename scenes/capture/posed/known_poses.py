"""Cameras, points and depth pictures that came with a capture, whatever format they were in.

World frames are the source's own; poses have OpenCV camera axes. Shapes: N pictures, P points, A
sightings.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerf2real.core.geometry.cameras import LENS, Camera
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import depth_pictures
from nerf2real.scenes.capture.posed.pictures import read_as_posed

CAMERA_TOLERANCE = 0.01  # relative difference of focal lengths that still is one camera
_STILL = 1e-6  # m and rad: motions below come from rounding


@dataclasses.dataclass(frozen=True)
class KnownPoses:
  """Cameras and points that came with the pictures."""

  kind: str
  """"colmap", "transforms" or "rgbd"."""
  camera: Camera
  """Of the original pictures."""
  files: tuple[Path, ...]
  """Picture of each pose."""
  world_from_camera: np.ndarray
  """[N, 4, 4], OpenCV camera axes, the source's frame."""
  points: np.ndarray
  """[P, 3], the source's frame; empty where the source has none."""
  point_colors: NDArray[np.uint8]
  """[P, 3]."""
  point_errors: np.ndarray
  """Mean reprojection error [P] [pixel]."""
  depth_files: tuple[Path, ...] = ()
  """Depth picture of each pose; empty where there was no sensor."""
  depth_unit: float = depth_pictures.MILLIMETRE
  """Of the depth pictures, in the unit of the poses."""
  depth_poses: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4, 4)))
  """World from camera [N, 4, 4] when each depth picture was measured; empty: those of the pictures.
  """
  warnings: tuple[str, ...] = ()
  """What was left out or assumed."""
  sightings: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))
  """Measured depth [A, 4]: picture, pixel x and y, distance along the pixel's ray."""

  def __post_init__(self):
    # JSON does not keep the columns of an array without rows.
    object.__setattr__(self, "sightings", self.sightings.reshape(-1, 4))
    for name in ("points", "point_colors"):
      object.__setattr__(self, name, getattr(self, name).reshape(-1, 3))
    object.__setattr__(self, "depth_poses", self.depth_poses.reshape(-1, 4, 4))

  def selected(self, indices: list[int], camera: Camera) -> "KnownPoses":
    """Keeps some of the pictures, with the camera of the pictures as they were written."""
    return dataclasses.replace(
      self,
      camera=camera,
      files=tuple(self.files[i] for i in indices),
      world_from_camera=self.world_from_camera[indices],
      depth_files=tuple(self.depth_files[i] for i in indices) if self.depth_files else (),
      depth_poses=self.depth_poses[indices] if len(self.depth_poses) else self.depth_poses,
    )

  @property
  def is_metric(self) -> bool:
    """Whether depth came along: poses are then taken to be in metres."""
    return len(self.sightings) > 0

  @property
  def names_unit(self) -> bool:
    """Whether the format says metres; transforms.json may have a depth in any, as of COLMAP's."""
    return self.kind == "rgbd"

  @property
  def picture_from_depth(self) -> np.ndarray | None:
    """The camera's motion [N, 4, 4] from each depth picture to its picture; None without any."""
    if not len(self.depth_poses):
      return None
    motion = np.linalg.inv(self.world_from_camera) @ self.depth_poses
    still = np.abs(motion - np.eye(4)).max() < _STILL
    return None if still else motion

  def lifted(self) -> "KnownPoses":
    """Returns the poses with points from the depth pictures; as they are where there are none."""
    if not self.depth_files:
      return self
    seen = depth_pictures.sightings(self.depth_files, self.depth_unit, self.camera)
    colors = [self._colors(k, seen[seen[:, 0] == k, 1:3]) for k in range(len(self.files))]
    lifted = dataclasses.replace(
      self, sightings=seen, point_colors=np.concatenate(colors), point_errors=np.zeros(len(seen))
    )
    return lifted.with_views(self.camera, self.world_from_camera)

  def with_views(self, camera: Camera, world_from_camera: np.ndarray) -> "KnownPoses":
    """Returns the same depth seen by another camera from other poses: its points move along."""
    seen = self.sightings.copy()
    depth = seen[:, 3] / np.linalg.norm(self.camera.rays(seen[:, 1:3]), axis=-1)
    local = depth[:, None] * camera.rays(seen[:, 1:3])
    seen[:, 3] = np.linalg.norm(local, axis=-1)
    poses = world_from_camera[seen[:, 0].astype(int)]
    depth_poses = self.depth_poses
    if len(depth_poses):
      depth_poses = world_from_camera @ np.linalg.inv(self.world_from_camera) @ depth_poses
    return dataclasses.replace(
      self,
      camera=camera,
      world_from_camera=world_from_camera,
      depth_poses=depth_poses,
      sightings=seen,
      points=np.einsum("aij,aj->ai", poses[:, :3, :3], local) + poses[:, :3, 3],
    )

  def _colors(self, index: int, pixels: np.ndarray) -> np.ndarray:
    """Colours uint8 [A, 3] of a picture at pixels [A, 2] of the camera."""
    image = read_as_posed(self.files[index], self.camera)
    scale = np.array([image.shape[1], image.shape[0]]) / [self.camera.width, self.camera.height]
    column, row = np.floor(pixels * scale).astype(int).T
    return image[row, column, ::-1]


def one_camera(cameras: list[Camera], source: Path) -> Camera:
  """Returns the camera that all pictures share; raises CaptureError if they differ."""
  first = cameras[0]
  for other in cameras[1:]:
    same_size = (other.width, other.height) == (first.width, first.height)
    if not same_size or abs(other.fx / first.fx - 1) > CAMERA_TOLERANCE:
      raise CaptureError(
        f"{source} has several cameras ({first.width}x{first.height} focal {first.fx:.0f} and "
        f"{other.width}x{other.height} focal {other.fx:.0f}); expected one camera and one zoom."
      )
  values: dict[str, Any] = {
    name: float(np.median([getattr(c, name) for c in cameras])) for name in LENS
  }
  return dataclasses.replace(first, **values)
