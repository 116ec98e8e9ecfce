"""Calibrates a camera from pictures of a checkerboard: an OPENCV model with its uncertainty.

Pixels follow OpenCV and ROS here: the centre of the upper left pixel is (0, 0).
`core.geometry.cameras` has it at (0.5, 0.5); `Calibration.camera` and
`core.geometry.camera_info` convert. N views.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from nerf2real.core import files
from nerf2real.core.geometry.cameras import LENS, Camera

MIN_VIEWS = 8  # chosen: eight numbers of the lens need well more than two views
_MIN_CORNERS = 3  # along a row or a column: OpenCV's
_OUTLIER = 2.5  # views with more than this times the median error are left out: chosen
_BLOCKS = 10  # of the jackknife: neighbouring frames of a video err alike
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_FLAGS = cv2.CALIB_FIX_K3  # the OPENCV model has two radial terms
_REFINEMENT = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
  """One picture in which the board was found."""

  name: str
  """Of the file or frame."""
  corners: np.ndarray
  """float32 [rows * columns, 2] pixel."""
  size: tuple[int, int]
  """Width, height of the picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibration:
  """A calibrated camera."""

  width: int
  """Of the pictures [pixel]."""
  height: int
  """Of the pictures [pixel]."""
  values: np.ndarray
  """[8] as `LENS`; focal lengths and centre in pixels, OpenCV's convention."""
  stddevs: np.ndarray
  """[8] standard deviations, block jackknife over the views."""
  rms: float
  """Of the reprojection error over the views kept [pixel]."""
  views: tuple[str, ...]
  """Kept."""
  rejected: tuple[str, ...]
  """Views that fitted badly."""
  coverage: float
  """Share of the picture's 8 x 6 cells in which a corner was seen."""

  @property
  def camera(self) -> Camera:
    """The camera in the convention of `core.geometry.cameras`."""
    fx, fy, cx, cy, *distortion = self.values
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Camera.from_opencv(self.width, self.height, matrix, distortion)


def read_pictures(source: Path, *, every: int = 1) -> Iterator[tuple[str, np.ndarray]]:
  """Yields names and grey pictures [H, W] of a video or a folder of pictures.

  Args:
    source: A video file, a picture or a folder of pictures.
    every: Takes every n-th picture only.

  Raises:
    ValueError: There is nothing readable, or `every` is less than 1.
  """
  if every < 1:
    raise ValueError(f"Every {every}-th picture was asked for, expected 1 (each) or more.")
  source = Path(source)
  if source.is_dir():
    paths = sorted(p for p in source.iterdir() if p.suffix.lower() in _PICTURES)
    if not paths:
      raise ValueError(f"{source} holds no pictures: expected files {', '.join(_PICTURES)}.")
    for path in paths[::every]:
      picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
      if picture is None:
        raise ValueError(f"{path} is not a picture that OpenCV reads: remove or replace it.")
      yield path.name, picture
    return
  if not source.is_file():
    raise ValueError(f"Found no {source}: expected a video or a folder of pictures of a board.")
  video = cv2.VideoCapture(str(source))
  index = 0
  try:
    while True:
      found, frame = video.read()
      if not found:
        break
      if index % every == 0:
        yield f"frame {index}", cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
      index += 1
  finally:
    video.release()
  if not index:
    raise ValueError(f"{source} is not a video that OpenCV reads: give a video or a folder.")


def find_board(name: str, picture: np.ndarray, *, corners: tuple[int, int]) -> View | None:
  """Finds the inner corners of a checkerboard, to a fraction of a pixel.

  Args:
    name: Of the picture.
    picture: Grey, uint8 [H, W].
    corners: Inner corners along a row and along a column: one less than squares.

  Returns:
    The view, or None if the board was not found.

  Raises:
    ValueError: OpenCV finds no board of so few corners.
  """
  if min(corners) < _MIN_CORNERS:
    raise ValueError(
      f"Found {corners[0]} x {corners[1]} inner corners, expected {_MIN_CORNERS} or more each: "
      "8 x 8 squares have 7 x 7."
    )
  flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
  found, rough = cv2.findChessboardCorners(picture, corners, flags=flags)
  if not found:
    return None
  grid = rough.reshape(corners[1], corners[0], 2)
  spacing = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
  # As much of the neighbourhood as holds no other corner.
  window = max(2, int(0.45 * spacing))
  fine = cv2.cornerSubPix(picture, rough, (window, window), (-1, -1), _REFINEMENT)
  size = (picture.shape[1], picture.shape[0])
  return View(name=name, corners=fine.reshape(-1, 2).astype(np.float32), size=size)


def calibrate(views: Iterable[View], *, corners: tuple[int, int]) -> Calibration:
  """Fits an OPENCV model to views of a board.

  Views whose error is far above the median (blurred, or wrongly found) are left out. The
  uncertainties are a block jackknife: the fit is repeated with each tenth of the views, in order,
  left out; the fit's own covariance takes neighbouring frames as independent and promises too much.

  Args:
    views: From `find_board`, in the order they were taken.
    corners: As in `find_board`.

  Raises:
    ValueError: Too few views, or of different sizes.
  """
  kept = list(views)
  _check(kept)
  width, height = kept[0].size
  board = np.zeros((corners[0] * corners[1], 3), np.float32)
  # squares of side 1: the lens does not depend on it
  board[:, :2] = np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2)
  values, errors = _fit(kept, board)
  limit = _OUTLIER * np.median(errors)
  rejected = tuple(v.name for v, e in zip(kept, errors, strict=True) if e > limit)
  if rejected:
    kept = [v for v, e in zip(kept, errors, strict=True) if e <= limit]
    _check(kept)
    values, errors = _fit(kept, board)
  cells = np.concatenate([v.corners for v in kept]) / (width, height) * (8, 6)
  seen = len(np.unique(np.clip(cells.astype(int), 0, (7, 5)), axis=0))
  return Calibration(
    width=width,
    height=height,
    values=values,
    stddevs=_jackknife(kept, board),
    rms=float(np.sqrt(np.mean(errors**2))),
    views=tuple(v.name for v in kept),
    rejected=rejected,
    coverage=seen / 48,
  )


def _check(views: list[View]) -> None:
  if len(views) < MIN_VIEWS:
    raise ValueError(
      f"Found the board in {len(views)} pictures, expected at least {MIN_VIEWS}: check the number "
      "of inner corners, hold the whole board in view, and tilt and move it between pictures."
    )
  sizes = {view.size for view in views}
  if len(sizes) > 1:
    raise ValueError(
      f"Found pictures of the sizes {sorted(sizes)}, expected one size: a lens's "
      "numbers hold for one size."
    )


def _fit(views: list[View], board: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the values [8] and each view's RMS error [N] [pixel]."""
  fit: Any = cv2.calibrateCameraExtended  # in its stubs the first guess may not be None
  fitted = fit(
    [board] * len(views), [v.corners for v in views], views[0].size, None, None, flags=_FLAGS
  )
  matrix, distortion, errors = fitted[1], fitted[2].ravel(), fitted[7].ravel()
  values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion[:4]]
  return np.array(values), errors


def _jackknife(views: list[View], board: np.ndarray) -> np.ndarray:
  """Returns standard deviations [8] by leaving out one block of neighbouring views at a time."""
  blocks = np.array_split(np.arange(len(views)), min(_BLOCKS, len(views)))
  fits = []
  for block in blocks:
    rest = [view for index, view in enumerate(views) if index not in block]
    fits.append(_fit(rest, board)[0])
  spread = np.array(fits) - np.mean(fits, axis=0)
  return np.sqrt((len(blocks) - 1) / len(blocks) * (spread**2).sum(axis=0))


def camera_info(calibration: Calibration, *, name: str = "camera") -> dict[str, Any]:
  """Returns the dictionary that ROS's camera_info YAML holds (camera_calibration_parsers)."""
  fx, fy, cx, cy, *distortion = (float(v) for v in calibration.values)
  return {
    "image_width": calibration.width,
    "image_height": calibration.height,
    "camera_name": name,
    "camera_matrix": _matrix(3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
    "distortion_model": "plumb_bob",
    "distortion_coefficients": _matrix(1, 5, [*distortion, 0]),
    "rectification_matrix": _matrix(3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
    "projection_matrix": _matrix(3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
  }


def _matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
  return {"rows": rows, "cols": cols, "data": [float(value) for value in data]}


def write_camera_info(path: Path, calibration: Calibration, *, name: str = "camera") -> None:
  """Writes the camera_info YAML; the uncertainties stand in comments, which ROS skips."""
  figures = zip(LENS, calibration.values, calibration.stddevs, strict=True)
  lines = [f"# {figure} {value:.6g} +- {stddev:.2g}" for figure, value, stddev in figures]
  lines.append(f"# RMS {calibration.rms:.3f} pixel over {len(calibration.views)} views")
  info = camera_info(calibration, name=name)
  text = yaml.safe_dump(info, sort_keys=False, default_flow_style=None)
  files.write_atomically(path, "\n".join(lines) + "\n" + text)
