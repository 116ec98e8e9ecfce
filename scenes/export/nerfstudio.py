"""Writes pictures and a transforms.json, as nerfstudio and instant-ngp read them: metres, z up."""

import json
from pathlib import Path

import numpy as np
import trimesh

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.rotations import OPENGL_FROM_OPENCV
from nerf2real.core.picture_files import write_picture
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.export import views
from nerf2real.scenes.poses import localisation
from nerf2real.scenes.stages.cache import key_of

POINTS = "sparse_points.ply"  # the localised points


def transforms(camera: Camera, world_from_camera: np.ndarray, names: list[str]) -> dict:
  """Returns the content of transforms.json.

  Source: nerfstudio documentation, data conventions: OpenGL camera axes, z up, model OPENCV.

  Args:
    camera: Of all pictures.
    world_from_camera: Poses [N, 4, 4], OpenCV camera axes.
    names: Path of each picture beside the file.
  """
  poses = np.array(world_from_camera, np.float64)
  poses[:, :3, :3] = poses[:, :3, :3] @ OPENGL_FROM_OPENCV
  return {
    "camera_model": "OPENCV",
    "w": camera.width,
    "h": camera.height,
    "fl_x": camera.fx,
    "fl_y": camera.fy,
    "cx": camera.cx,
    "cy": camera.cy,
    "k1": camera.k1,
    "k2": camera.k2,
    "p1": camera.p1,
    "p2": camera.p2,
    "ply_file_path": POINTS,
    "frames": [
      {"file_path": name, "transform_matrix": pose.tolist()}
      for name, pose in zip(names, poses, strict=True)
    ],
  }


def write(folder: Path, bundle: Bundle, *, progress: Progress = no_progress) -> str:
  """Writes transforms.json, images/ and the localised points; the folder appears whole.

  The pictures are the capture's keyframes, without rolling shutter as the poses are; where the
  bundle lacks one, all are rendered from the field.

  Args:
    folder: Where to; an older one is replaced.
    bundle: The scene.
    progress: Called with the fraction done and a text.

  Raises:
    ValueError: The keyframes beside the bundle were taken anew since it was made.

  Returns:
    Where the pictures come from, for the user: "keyframes" or "rendered from the field".
  """
  camera, poses, names = views.capture_cameras(bundle)
  localised = localisation.load(bundle.folder / "sfm")
  keyframes = bundle.keyframes_folder
  found = all((keyframes / name).is_file() for name in names)
  made_of = bundle.scene.get("hashes", {}).get("keyframes")
  if found and made_of not in (None, key_of(keyframes.parent)):
    raise ValueError(
      f"{keyframes.parent} holds other keyframes than the scene was made of: run "
      f"launch/make_scene.py with {bundle.folder} as --out to the end, then export again."
    )
  renderer = None if found else views.renderer_of(bundle)
  unit_from_world = bundle.world_from_unit.inverse()
  with files.atomic_folder(folder) as partial:
    (partial / "images").mkdir()
    for index, (name, pose) in enumerate(zip(names, poses, strict=True)):
      target = partial / "images" / name
      if renderer is not None:
        picture = renderer.render(camera, unit_from_world.apply_pose(pose))[0][..., ::-1]
        write_picture(target, picture)
      elif localised.shutter is None:
        target.write_bytes((keyframes / name).read_bytes())
      else:
        write_picture(target, localised.read_picture(keyframes, index))
      progress((index + 1) / len(names), f"picture {index + 1} of {len(names)}")
    cloud = trimesh.PointCloud(
      bundle.world_from_unit.apply(localised.points), localised.point_colors
    )
    cloud.export(str(partial / POINTS))
    content = transforms(camera, poses, [f"images/{name}" for name in names])
    (partial / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
  return "keyframes" if found else "rendered from the field"
