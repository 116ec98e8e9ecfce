"""COLMAP models as known poses, and the conversion of their cameras."""

from pathlib import Path

import numpy as np

from nerf2real.core.geometry.cameras import LENS, Camera
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed.known_poses import KnownPoses, one_camera
from nerf2real.scenes.colmap import pycolmap

_PARTS = ("cameras", "images", "points3D")  # files of a model


def find_colmap_model(source: Path) -> Path | None:
  """Returns the folder inside `source` that holds a COLMAP model, None if there is none."""
  for folder in (source, source / "sparse" / "0", source / "sparse", source / "sfm"):
    if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
      return folder
  return None


def to_opencv(camera: pycolmap.Camera) -> Camera:
  """Converts a COLMAP camera; models that OPENCV does not contain raise CaptureError."""
  values = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params, strict=True))
  if "f" in values:
    values["fx"] = values["fy"] = values.pop("f")
  if "k" in values:
    values["k1"] = values.pop("k")
  extra = {name for name in set(values) - set(LENS) if values[name] != 0}
  if extra or "FISHEYE" in camera.model_name or camera.model_name == "FOV":
    raise CaptureError(
      f"The COLMAP model has a {camera.model_name} camera, expected one that OPENCV contains "
      "(SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV): give the pictures alone, or "
      "undistort them."
    )
  values = {name: float(values[name]) for name in values if name in LENS}
  return Camera(width=camera.width, height=camera.height, **values)


def camera_of(model: pycolmap.Reconstruction) -> Camera:
  """Returns the camera of a model that has one; see `to_opencv`."""
  return to_opencv(next(iter(model.cameras.values())))


def to_colmap(camera: Camera) -> pycolmap.Camera:
  """Converts to COLMAP's OPENCV camera."""
  return pycolmap.Camera(
    camera_id=1, model="OPENCV", width=camera.width, height=camera.height, params=camera.lens
  )


def read_colmap(source: Path) -> KnownPoses:
  """Reads a COLMAP model (binary or text) and finds its pictures."""
  folder = find_colmap_model(source)
  if folder is None:
    raise CaptureError(f"{source} holds no COLMAP model: expected cameras.bin or cameras.txt.")
  suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
  lacks = [f"{part}{suffix}" for part in _PARTS if not (folder / f"{part}{suffix}").is_file()]
  if lacks:
    raise CaptureError(
      f"The COLMAP model in {folder} lacks {' and '.join(lacks)}: copy the whole model, or export "
      "it again (colmap model_converter)."
    )
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
  used = sorted({i.camera_id for i in images})  # a model may list cameras of no picture
  poses = np.tile(np.eye(4), (len(images), 1, 1))
  poses[:, :3] = [i.cam_from_world().inverse().matrix() for i in images]
  return KnownPoses(
    kind="colmap",
    camera=one_camera([to_opencv(model.cameras[k]) for k in used], source),
    files=tuple(root / i.name for i in images),
    world_from_camera=poses,
    points=np.array([p.xyz for p in points]).reshape(-1, 3),
    point_colors=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
    point_errors=np.array([p.error for p in points]),
  )
