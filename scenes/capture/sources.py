"""Sources with known cameras: COLMAP models, transforms.json, RGB-D sequences (`rgbd`).

World frames are the source's own; poses come out with OpenCV camera axes. Shapes: N pictures, P
points, A sightings.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nerf2real.core.cameras import Camera, focal_length
from nerf2real.core.rotations import OPENGL_FROM_OPENCV, is_rigid
from nerf2real.scenes.capture import depth_pictures, rgbd
from nerf2real.scenes.capture.stills import APPLE_SUFFIXES
from nerf2real.scenes.capture.video import CaptureError
from nerf2real.scenes.colmap import pycolmap

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", *APPLE_SUFFIXES)
CAMERA_TOLERANCE = 0.01  # relative difference of focal lengths that still is one camera


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
  warnings: tuple[str, ...] = ()
  """What was left out or assumed."""
  sightings: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4)))
  """Measured depth [A, 4]: picture, pixel x and y, distance along the pixel's ray."""

  def __post_init__(self):
    # JSON does not keep the columns of an array without rows.
    object.__setattr__(self, "sightings", self.sightings.reshape(-1, 4))
    for name in ("points", "point_colors"):
      object.__setattr__(self, name, getattr(self, name).reshape(-1, 3))

  def selected(self, indices: list[int], camera: Camera) -> "KnownPoses":
    """Keeps some of the pictures, with the camera of the pictures as they were written."""
    return dataclasses.replace(
      self,
      camera=camera,
      files=tuple(self.files[i] for i in indices),
      world_from_camera=self.world_from_camera[indices],
      depth_files=tuple(self.depth_files[i] for i in indices) if self.depth_files else (),
    )

  @property
  def is_metric(self) -> bool:
    """Whether a depth sensor measured: poses are then in metres."""
    return len(self.sightings) > 0

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
    return dataclasses.replace(
      self,
      camera=camera,
      world_from_camera=world_from_camera,
      sightings=seen,
      points=np.einsum("aij,aj->ai", poses[:, :3, :3], local) + poses[:, :3, 3],
    )

  def _colors(self, index: int, pixels: np.ndarray) -> np.ndarray:
    """Colours uint8 [A, 3] of a picture at pixels [A, 2] of the camera."""
    image = cv2.imread(str(self.files[index]))
    if image is None:
      raise CaptureError(f"{self.files[index]} cannot be read as a picture.")
    scale = np.array([image.shape[1], image.shape[0]]) / [self.camera.width, self.camera.height]
    column, row = np.floor(pixels * scale).astype(int).T
    return image[row, column, ::-1]


def find_colmap_model(source: Path) -> Path | None:
  """Returns the folder inside `source` that holds a COLMAP model, None if there is none."""
  for folder in (source, source / "sparse" / "0", source / "sparse", source / "sfm"):
    if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
      return folder
  return None


def find_transforms(source: Path) -> Path | None:
  """Returns the transforms file that `source` is or holds, None if there is none."""
  if source.is_file():
    return source if source.suffix == ".json" else None
  for name in ("transforms.json", "transforms_train.json"):
    if (source / name).is_file():
      return source / name
  return None


def list_images(folder: Path) -> list[Path]:
  """Lists the pictures of a folder (not of its subfolders), sorted by name."""
  return sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())


def to_opencv(camera: pycolmap.Camera) -> Camera:
  """Converts a COLMAP camera; models that OPENCV does not contain raise CaptureError."""
  values = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params, strict=True))
  if "f" in values:
    values["fx"] = values["fy"] = values.pop("f")
  if "k" in values:
    values["k1"] = values.pop("k")
  known = {"fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"}
  extra = {name for name in set(values) - known if values[name] != 0}
  if extra or "FISHEYE" in camera.model_name or camera.model_name == "FOV":
    raise CaptureError(
      f"The COLMAP model has a {camera.model_name} camera, expected one that OPENCV contains "
      "(SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV): give the pictures alone, or "
      "undistort them."
    )
  values = {name: float(values[name]) for name in values if name in known}
  return Camera(width=camera.width, height=camera.height, **values)


def to_colmap(camera: Camera) -> pycolmap.Camera:
  """Converts to COLMAP's OPENCV camera."""
  params = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
  return pycolmap.Camera(
    camera_id=1, model="OPENCV", width=camera.width, height=camera.height, params=params
  )


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
    name: float(np.median([getattr(c, name) for c in cameras]))
    for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
  }
  return dataclasses.replace(first, **values)


def read_colmap(source: Path) -> KnownPoses:
  """Reads a COLMAP model (binary or text) and finds its pictures."""
  folder = find_colmap_model(source)
  if folder is None:
    raise CaptureError(f"{source} holds no COLMAP model: expected cameras.bin or cameras.txt.")
  try:
    model = pycolmap.Reconstruction(str(folder))
  except (ValueError, RuntimeError, IndexError) as error:
    raise CaptureError(f"The COLMAP model in {folder} cannot be read: {error}") from error
  images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
  if not images:
    raise CaptureError(f"The COLMAP model in {folder} has no registered picture.")
  roots = [source / "images", source, *(parent / "images" for parent in folder.parents[:3])]
  root = next((r for r in roots if (r / images[0].name).is_file()), None)
  if root is None:
    raise CaptureError(
      f"Picture {images[0].name} of the COLMAP model was not found in {source / 'images'}: put the "
      "pictures into a folder 'images' beside the model."
    )
  missing = [i.name for i in images if not (root / i.name).is_file()]
  if missing:
    raise CaptureError(f"{len(missing)} pictures of the COLMAP model are missing, as {missing[0]}.")
  points = list(model.points3D.values())
  poses = np.tile(np.eye(4), (len(images), 1, 1))
  poses[:, :3] = [i.cam_from_world().inverse().matrix() for i in images]
  return KnownPoses(
    kind="colmap",
    camera=one_camera([to_opencv(c) for c in model.cameras.values()], source),
    files=tuple(root / i.name for i in images),
    world_from_camera=poses,
    points=np.array([p.xyz for p in points]).reshape(-1, 3),
    point_colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    point_errors=np.array([p.error for p in points]),
  )


def _transforms_camera(values: dict[str, Any], path: Path) -> Camera:
  """Reads the intrinsics of a transforms.json or of one of its frames."""
  if values.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
    raise CaptureError(f"{path}: camera_model {values['camera_model']} found, expected OPENCV.")
  if "w" not in values or "h" not in values:
    raise CaptureError(f"{path}: no picture size 'w' and 'h' found; add it.")
  width, height = int(values["w"]), int(values["h"])
  if "fl_x" in values:
    fx = float(values["fl_x"])
  elif "camera_angle_x" in values:
    fx = focal_length(float(values["camera_angle_x"]), width)
  else:
    raise CaptureError(f"{path}: no focal length: expected 'fl_x' or 'camera_angle_x'.")
  if "fl_y" in values:
    fy = float(values["fl_y"])
  elif "camera_angle_y" in values and "fl_x" not in values:
    fy = focal_length(float(values["camera_angle_y"]), height)
  else:
    fy = fx
  distortion = {name: float(values.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2")}
  cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
  return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, **distortion)


def _frame_file(folder: Path, name: str) -> Path:
  """Resolves a frame's file_path; synthetic scenes of instant-ngp leave the suffix out."""
  path = folder / name
  for candidate in (path, *(path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES)):
    if candidate.is_file():
      return candidate
  raise CaptureError(f"Picture {name} of the transforms file was not found in {folder}.")


def read_transforms(source: Path) -> KnownPoses:
  """Reads a transforms.json of nerfstudio or instant-ngp.

  The file's transform_matrix is world-from-camera with OpenGL camera axes (x right, y up, z back);
  the result has OpenCV axes. Sources: nerfstudio documentation, data conventions; instant-ngp
  documentation, nerf_dataset_tips.
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
  files = tuple(_frame_file(path.parent, frame["file_path"]) for frame in frames)
  if "w" not in values and "w" not in frames[0]:
    picture = cv2.imread(str(files[0]))
    if picture is None:
      raise CaptureError(f"{files[0]} cannot be read as a picture.")
    values = {**values, "w": picture.shape[1], "h": picture.shape[0]}
  camera = one_camera([_transforms_camera({**values, **frame}, path) for frame in frames], path)
  named = [frame.get("depth_file_path") for frame in frames]
  depth_files = tuple(_frame_file(path.parent, name) for name in named if name)
  poses = []
  for frame, matrix in zip(frames, matrices, strict=True):
    if matrix.shape == (3, 4):
      matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4) or not is_rigid(matrix):
      raise CaptureError(f"{path}: transform_matrix of {frame['file_path']} is no rigid pose.")
    matrix[:3, :3] = matrix[:3, :3] @ OPENGL_FROM_OPENCV
    poses.append(matrix)
  empty = np.zeros((0, 3))
  return KnownPoses(
    kind="transforms",
    camera=camera,
    files=files,
    world_from_camera=np.stack(poses),
    points=empty,
    point_colors=empty.astype(np.uint8),
    point_errors=np.zeros(0),
    depth_files=depth_files if len(depth_files) == len(frames) else (),
  )


def read_rgbd(source: Path) -> KnownPoses:
  """Reads an RGB-D sequence with known poses, in TUM's, 7-Scenes' or ScanNet's layout."""
  layout = rgbd.find_rgbd(source)
  if layout is None:
    raise CaptureError(f"{source} holds no RGB-D sequence: expected rgb.txt and groundtruth.txt.")
  found = rgbd.READERS[layout](source)
  assert found.camera is not None  # every reader finds one or raises
  empty = np.zeros((0, 3))
  return KnownPoses(
    kind="rgbd",
    camera=found.camera,
    files=tuple(found.files),
    world_from_camera=found.poses,
    points=empty,
    point_colors=empty.astype(np.uint8),
    point_errors=np.zeros(0),
    depth_files=tuple(found.depth),
    depth_unit=found.unit,
    warnings=found.warnings,
  )
