"""RGB-D sequences with known poses: TUM's (`tum`), 7-Scenes' and ScanNet's folders.

Sources: Shotton et al. 2013, Scene coordinate regression forests (7-Scenes' readme); Dai et al.
2017, ScanNet (what its SensReader writes). Shapes: N pictures.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from nerf2real.core.geometry.rotations import is_rigid
from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed.depth_pictures import MILLIMETRE
from nerf2real.scenes.capture.posed.known_poses import KnownPoses
from nerf2real.scenes.capture.posed.recording import Recording, camera_of
from nerf2real.scenes.capture.posed.tum import is_tum, read_tum

_COLOR = ("color", "rgb", "images")  # ScanNet's folder of pictures, and what others call it

_POSES = "pose/[!.]*.txt"  # ScanNet's, without the hidden files that macOS adds


def find_rgbd(source: Path) -> str | None:
  """Layout of an RGB-D sequence's folder: "tum", "7scenes" or "scannet"; None if it is none."""
  if not source.is_dir():
    return None
  if is_tum(source):
    return "tum"
  if any(source.glob("frame-*.pose.txt")):
    return "7scenes"
  return "scannet" if any(source.glob(_POSES)) and _color_folder(source) else None


def _color_folder(source: Path) -> Path | None:
  return next((source / name for name in _COLOR if (source / name).is_dir()), None)


def _posed(
  poses: Sequence[Path], picture: Callable[[Path], Path], depth: Callable[[Path], Path]
) -> Recording:
  """Reads files of one pose each; lost frames, whose pose is not finite, are left out.

  Args:
    poses: Files of 4 rows of 4 numbers, world from camera.
    picture: Gives a pose's picture.
    depth: Gives a pose's depth picture.

  Raises:
    CaptureError: A pose is damaged, or none is finite.
  """
  matrices = []
  for path in poses:
    try:
      matrix = np.loadtxt(path)
    except ValueError as error:
      raise CaptureError(f"{path} is no pose: expected 4 rows of 4 numbers ({error}).") from error
    if matrix.shape != (4, 4):
      raise CaptureError(f"{path} is no pose: found shape {matrix.shape}, expected 4 rows of 4.")
    if np.isfinite(matrix).all() and not is_rigid(matrix):
      raise CaptureError(f"{path} is no pose: its 3x3 part is no rotation.")
    matrices.append(matrix)
  return Recording(
    files=[picture(path) for path in poses],
    poses=np.stack(matrices),
    depth=[depth(path) for path in poses],
    unit=MILLIMETRE,
  ).placed(poses[0].parent)


def read_seven_scenes(source: Path) -> Recording:
  """Reads a folder of frame-*.color.png, frame-*.depth.png and frame-*.pose.txt."""

  def beside(path: Path, kind: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.pose.txt')}.{kind}")

  poses = sorted(source.glob("frame-*.pose.txt"))
  suffix = "color.jpg" if beside(poses[0], "color.jpg").is_file() else "color.png"
  found = _posed(poses, lambda path: beside(path, suffix), lambda path: beside(path, "depth.png"))
  return camera_of(found.present(source), source, focal=585.0, what="7-Scenes'")


def read_scannet(source: Path) -> Recording:
  """Reads color/*.jpg, depth/*.png, pose/*.txt and intrinsic/intrinsic_color.txt."""
  folder = _color_folder(source)
  assert folder is not None  # `find_rgbd` has found it
  named = {path.stem: path for path in sorted(folder.iterdir())}
  found = _posed(
    sorted(source.glob(_POSES), key=lambda path: (len(path.stem), path.stem)),
    lambda path: named.get(path.stem, folder / f"{path.stem}.jpg"),
    lambda path: source / "depth" / f"{path.stem}.png",
  )
  return camera_of(found.present(source), source, focal=577.9, what="ScanNet's reduced")


READERS = {"tum": read_tum, "7scenes": read_seven_scenes, "scannet": read_scannet}


def read_rgbd(source: Path) -> KnownPoses:
  """Reads an RGB-D sequence with known poses, in TUM's, 7-Scenes' or ScanNet's layout."""
  layout = find_rgbd(source)
  if layout is None:
    raise CaptureError(f"{source} holds no RGB-D sequence: expected rgb.txt and groundtruth.txt.")
  found = READERS[layout](source)
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
    depth_poses=np.zeros((0, 4, 4)) if found.depth_poses is None else found.depth_poses,
    warnings=found.warnings,
  )
