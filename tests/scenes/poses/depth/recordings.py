"""Recordings of a depth camera with poses, for the tests of what depth tells."""

from pathlib import Path

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.capture.capture import Capture
from nerf2real.scenes.capture.posed.known_poses import KnownPoses

UNIT = 1e-3  # m, of the depth pictures


def counts(depth: np.ndarray) -> np.ndarray:
  """Depth [m] as its pictures hold it, 0 where it is not finite."""
  return np.rint(np.where(np.isfinite(depth), depth, 0.0) / UNIT).astype(np.uint16)


def recorded(
  folder: Path, pictures, depth: np.ndarray, camera: Camera, poses: np.ndarray, **known
) -> Capture:
  """Writes pictures [N, H, W, 3] and depth uint16 [N, H, W], and returns the capture of them."""
  images, files = [], []
  for kind in ("pictures", "depth"):
    (folder / kind).mkdir(parents=True, exist_ok=True)
  for row, (picture, raw) in enumerate(zip(pictures, depth, strict=True)):
    images.append(folder / "pictures" / f"frame_{row:06d}.png")
    files.append(folder / "depth" / f"{row}.png")
    cv2.imwrite(str(images[-1]), picture)
    cv2.imwrite(str(files[-1]), raw)
  about = KnownPoses(
    kind="rgbd",
    camera=camera,
    files=tuple(images),
    world_from_camera=poses,
    points=np.zeros((0, 3)),
    point_colors=np.zeros((0, 3), np.uint8),
    point_errors=np.zeros(0),
    depth_files=tuple(files),
    depth_unit=UNIT,
    **known,
  ).lifted()
  ones, size = np.ones(len(images)), (camera.width, camera.height)
  return Capture("rgbd", folder / "pictures", images, *size, ones, ones, ones, None, [], about)
