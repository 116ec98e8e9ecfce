"""RGB-D sequences with known poses: TUM's, 7-Scenes' and ScanNet's folders, and depth pictures.

Sources: Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems (file formats and
intrinsics on the benchmark's page); Shotton et al. 2013, Scene coordinate regression forests
(7-Scenes' readme); Dai et al. 2017, ScanNet (what its SensReader writes). Shapes: N pictures, A
sightings.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.camera_info import read_camera_info
from nerf2real.core.cameras import Camera
from nerf2real.scenes.capture.video import CaptureError

_SAME_TIME = 0.02  # s between a picture and its pose or depth; as in TUM's own tools
_SIGHTINGS = 400  # points lifted from a picture
_INVALID = 65535  # 7-Scenes' value where no depth was measured; 0 is everybody's
_INTRINSICS = "camera_info.yaml"  # optional file that overrides the data sets' nominal cameras
_TUM_CAMERA = Camera(width=640, height=480, fx=525.0, fy=525.0, cx=320.0, cy=240.0)
_SEVEN_SCENES_CAMERA = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
_TUM_DEPTH_UNIT = 1 / 5000  # m
MILLIMETRE = 1e-3  # m: 7-Scenes' and nerfstudio's depth


def find_rgbd(source: Path) -> str | None:
  """Layout of an RGB-D sequence's folder: "tum", "7scenes" or "scannet"; None if it is none."""
  if not source.is_dir():
    return None
  if (source / "rgb.txt").is_file() and (source / "groundtruth.txt").is_file():
    return "tum"
  if any(source.glob("frame-*.pose.txt")):
    return "7scenes"
  return "scannet" if any(source.glob("pose/*.txt")) and (source / "color").is_dir() else None


def _table(path: Path, columns: int) -> list[list[str]]:
  """Rows of a text file of TUM's: words, without comments."""
  if not path.is_file():
    raise CaptureError(f"{path} is missing: a sequence of TUM's layout needs it.")
  rows = [
    line.split() for line in path.read_text().splitlines() if line.strip()[:1] not in ("", "#")
  ]
  if not rows or any(len(row) < columns for row in rows):
    raise CaptureError(f"{path} is no list of TUM's layout: expected {columns} columns a line.")
  return rows


def _nearest(times: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Index of the nearest of `times` for each wanted time, and whether it is near enough."""
  order = np.argsort(times)
  right = np.clip(np.searchsorted(times[order], wanted), 1, max(len(times) - 1, 1))
  left = right - 1
  right = np.minimum(right, len(times) - 1)
  earlier = wanted - times[order[left]] < times[order[right]] - wanted
  index = order[np.where(earlier, left, right)]
  return index, np.abs(times[index] - wanted) <= _SAME_TIME


def read_tum(source: Path) -> tuple[Camera, list[Path], np.ndarray, list[Path], float]:
  """Reads a folder with rgb.txt, groundtruth.txt and, where there is depth, depth.txt.

  Returns:
    The camera, pictures, poses [N, 4, 4] with OpenCV axes [m], depth pictures (none or one each)
    and their unit [m].

  Raises:
    CaptureError: A list is damaged, or no picture has a pose.
  """
  pictures, poses = _table(source / "rgb.txt", 2), _table(source / "groundtruth.txt", 8)
  try:
    times = np.array([float(row[0]) for row in pictures])
    values = np.array([[float(word) for word in row[:8]] for row in poses])
  except ValueError as error:
    raise CaptureError(f"{source}: a time or pose is no number ({error}).") from error
  index, known = _nearest(values[:, 0], times)
  files = [source / row[1] for row in pictures]
  depth: list[Path] = []
  if (source / "depth.txt").is_file():
    listed = _table(source / "depth.txt", 2)
    near, has_depth = _nearest(np.array([float(row[0]) for row in listed]), times)
    known &= has_depth
    depth = [source / listed[k][1] for k in near]
  if not known.any():
    raise CaptureError(
      f"{source}: no picture has a pose within {_SAME_TIME:g} s: expected rgb.txt and "
      "groundtruth.txt of one recording."
    )
  chosen = np.flatnonzero(known)
  matrices = np.tile(np.eye(4), (len(chosen), 1, 1))
  matrices[:, :3, 3] = values[index[chosen], 1:4]
  matrices[:, :3, :3] = Rotation.from_quat(values[index[chosen], 4:8]).as_matrix()
  kept = [files[k] for k in chosen], [depth[k] for k in chosen] if depth else []
  return _camera(source, _TUM_CAMERA), kept[0], matrices, kept[1], _TUM_DEPTH_UNIT


def _posed(
  poses: Sequence[Path], picture: Callable[[Path], Path], depth: Callable[[Path], Path]
) -> tuple[list[Path], np.ndarray, list[Path]]:
  """Reads files of one pose each; lost frames, whose pose is not finite, are left out.

  Args:
    poses: Files of 4 rows of 4 numbers, world from camera.
    picture: Gives a pose's picture.
    depth: Gives a pose's depth picture.

  Returns:
    Pictures, poses [N, 4, 4] and depth pictures (none where one is missing).

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
    matrices.append(matrix)
  found = [path for path, matrix in zip(poses, matrices, strict=True) if np.isfinite(matrix).all()]
  if not found:
    raise CaptureError(f"{poses[0].parent}: no file such as {poses[0].name} holds a finite pose.")
  measured = [depth(path) for path in found]
  finite = np.stack([matrix for matrix in matrices if np.isfinite(matrix).all()])
  has_depth = all(path.is_file() for path in measured)
  return [picture(path) for path in found], finite, measured if has_depth else []


def read_seven_scenes(source: Path) -> tuple[Camera, list[Path], np.ndarray, list[Path], float]:
  """Reads a folder of frame-*.color.png, frame-*.depth.png and frame-*.pose.txt; as `read_tum`."""

  def beside(path: Path, kind: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.pose.txt')}.{kind}")

  poses = sorted(source.glob("frame-*.pose.txt"))
  suffix = "color.jpg" if beside(poses[0], "color.jpg").is_file() else "color.png"
  files, matrices, depth = _posed(
    poses, lambda path: beside(path, suffix), lambda path: beside(path, "depth.png")
  )
  return _camera(source, _SEVEN_SCENES_CAMERA), files, matrices, depth, MILLIMETRE


def read_scannet(source: Path) -> tuple[Camera, list[Path], np.ndarray, list[Path], float]:
  """Reads color/*.jpg, depth/*.png, pose/*.txt and intrinsic/intrinsic_color.txt; as `read_tum`."""
  suffix = ".png" if any(source.glob("color/*.png")) else ".jpg"
  files, matrices, depth = _posed(
    sorted(source.glob("pose/*.txt"), key=lambda path: (len(path.stem), path.stem)),
    lambda path: source / "color" / f"{path.stem}{suffix}",
    lambda path: source / "depth" / f"{path.stem}.png",
  )
  given = source / "intrinsic" / "intrinsic_color.txt"
  if (source / _INTRINSICS).is_file():
    return read_camera_info(source / _INTRINSICS), files, matrices, depth, MILLIMETRE
  picture = cv2.imread(str(files[0])) if given.is_file() else None
  if picture is None:
    raise CaptureError(f"{given} or {files[0].name} is missing or damaged: expected both.")
  matrix = np.loadtxt(given)
  height, width = picture.shape[:2]
  camera = Camera(
    width=width, height=height, fx=matrix[0, 0], fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2]
  )
  return camera, files, matrices, depth, MILLIMETRE


def _camera(source: Path, nominal: Camera) -> Camera:
  """The camera of the optional camera_info.yaml, or else the data set's nominal one."""
  path = source / _INTRINSICS
  return read_camera_info(path) if path.is_file() else nominal


def _read(path: Path) -> np.ndarray:
  """Reads a depth picture, uint16 [H, W]; what counts as not measured is 0."""
  depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
  if depth is None or depth.ndim != 2:
    raise CaptureError(f"{path} cannot be read as a depth picture: expected 16-bit grey.")
  return np.where(depth == _INVALID, 0, depth)


def measured_depth(path: Path, unit: float, camera: Camera) -> np.ndarray:
  """Reads a depth picture at a camera's size, the nearest pixel each.

  Args:
    path: 16-bit picture, z-depth in a unit, of the same view as the camera's.
    unit: That unit [m].
    camera: Of the pictures; may be smaller.

  Returns:
    z-depth float32 [H, W] [m]; 0 where nothing was measured.
  """
  depth = _read(path)
  row, column = (
    ((np.arange(size) + 0.5) * length / size).astype(int)
    for size, length in zip((camera.height, camera.width), depth.shape, strict=True)
  )
  return (depth[row][:, column] * unit).astype(np.float32)


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
    depth = _read(path)
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


READERS = {"tum": read_tum, "7scenes": read_seven_scenes, "scannet": read_scannet}
