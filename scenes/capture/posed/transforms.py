"""Known poses of a transforms.json, as nerfstudio and instant-ngp write it."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.core.geometry.cameras import Camera, focal_length
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV, is_rigid
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.media.stills import IMAGE_SUFFIXES
from nerf2real.scenes.capture.posed.depth_pictures import MILLIMETRE
from nerf2real.scenes.capture.posed.intrinsics import picture_size
from nerf2real.scenes.capture.posed.known_poses import KnownPoses, one_camera
from nerf2real.scenes.capture.posed.recording import Recording

_NO_DEPTH = "no depth_file_path"  # stands for a depth picture that a frame does not name
_UNDISTORT = "undistort the pictures, or give them alone"


def find_transforms(source: Path) -> Path | None:
  """Returns the transforms file that `source` is or holds, None if there is none."""
  if source.is_file():
    return source if source.suffix == ".json" else None
  for name in ("transforms.json", "transforms_train.json"):
    if (source / name).is_file():
      return source / name
  return None


def _transforms_camera(values: dict[str, Any], path: Path) -> Camera:
  """Reads the intrinsics of a transforms.json or of one of its frames."""

  def number(name: str, default: float = 0.0) -> float:
    try:
      value = float(values.get(name, default))
    except (TypeError, ValueError):
      value = math.nan
    if not math.isfinite(value):
      raise CaptureError(f"{path}: {name} = {values[name]!r} found, expected a number.")
    return value

  model = values.get("camera_model", "OPENCV")
  if values.get("is_fisheye"):  # instant-ngp's word for OpenCV's model
    model = "OPENCV_FISHEYE"
  if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
    raise CaptureError(f"{path}: camera_model {model} found, expected OPENCV: {_UNDISTORT}.")
  more = [name for name in ("k3", "k4") if number(name) != 0]
  if more:
    raise CaptureError(
      f"{path}: {more[0]} = {values[more[0]]} found, expected a lens of k1, k2, p1, p2 alone: "
      f"{_UNDISTORT}."
    )
  if "w" not in values or "h" not in values:
    raise CaptureError(f"{path}: no picture size 'w' and 'h' found; add it.")
  width, height = int(number("w")), int(number("h"))
  if "fl_x" in values:
    fx = number("fl_x")
  elif "camera_angle_x" in values:
    fx = focal_length(number("camera_angle_x"), width)
  else:
    raise CaptureError(f"{path}: no focal length: expected 'fl_x' or 'camera_angle_x'.")
  if "fl_y" in values:
    fy = number("fl_y")
  elif "camera_angle_y" in values and "fl_x" not in values:
    fy = focal_length(number("camera_angle_y"), height)
  else:
    fy = fx
  distortion = {name: number(name) for name in ("k1", "k2", "p1", "p2")}
  cx, cy = number("cx", width / 2), number("cy", height / 2)
  try:
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, **distortion)
  except ValueError as error:
    raise CaptureError(f"{path}: {error}") from error


def _frame_file(folder: Path, name: str) -> Path:
  """Resolves a frame's file_path, which may be missing; instant-ngp may leave its suffix out."""
  path = folder / name.replace("\\", "/")  # of Windows
  candidates = (path, *(path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES))
  return next((candidate for candidate in candidates if candidate.is_file()), path)


def read_transforms(source: Path) -> KnownPoses:
  """Reads a transforms.json of nerfstudio or instant-ngp.

  The file's transform_matrix is world-from-camera with OpenGL camera axes (x right, y up, z back);
  the result has OpenCV axes. Sources: nerfstudio documentation, data conventions; instant-ngp
  documentation, nerf_dataset_tips.

  Raises:
    CaptureError: The file is damaged, its lens is no OPENCV camera's, or most pictures are missing.
  """
  path = find_transforms(source)
  if path is None:
    raise CaptureError(f"{source} holds no transforms.json.")
  try:
    values = json.loads(path.read_text())
    frames = sorted(values["frames"], key=lambda frame: frame["file_path"])
    matrices = [np.array(frame["transform_matrix"], np.float64) for frame in frames]
  except (KeyError, TypeError, ValueError) as error:
    raise CaptureError(f"{path} is no transforms file of nerfstudio: {error!r}.") from error
  if not frames:
    raise CaptureError(f"{path} lists no frames.")
  for name in (frame.get(key) for frame in frames for key in ("file_path", "depth_file_path")):
    if not isinstance(name, str | None):
      raise CaptureError(f"{path}: {name!r} found as a picture's path, expected text.")
  poses = []
  for frame, matrix in zip(frames, matrices, strict=True):
    if matrix.shape == (3, 4):
      matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or (np.isfinite(matrix).all() and not is_rigid(matrix)):
      raise CaptureError(f"{path}: transform_matrix of {frame['file_path']} is no rigid pose.")
    matrix[:3, :3] *= np.diag(OPENGL_FROM_OPENCV)
    poses.append(matrix)
  named = [frame.get("depth_file_path") for frame in frames]
  found = Recording(
    files=[_frame_file(path.parent, frame["file_path"]) for frame in frames],
    poses=np.stack(poses),
    depth=[_frame_file(path.parent, name or _NO_DEPTH) for name in named] if any(named) else [],
    unit=MILLIMETRE,
  )
  found = found.placed(path).present(path)
  if "w" not in values and "w" not in frames[0]:
    width, height = picture_size(found.files[0])
    values = {**values, "w": width, "h": height}
  camera = one_camera([_transforms_camera({**values, **frame}, path) for frame in frames], path)
  empty = np.zeros((0, 3))
  return KnownPoses(
    kind="transforms",
    camera=camera,
    files=tuple(found.files),
    world_from_camera=found.poses,
    points=empty,
    point_colors=empty.astype(np.uint8),
    point_errors=np.zeros(0),
    depth_files=tuple(found.depth),
    depth_unit=found.unit,
    warnings=found.warnings,
  )
