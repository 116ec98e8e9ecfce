"""Metric scale from ArUco or AprilTag markers of known size in the keyframes.

A marker's corners are detected in every keyframe, triangulated with the localised poses, and a
rigid square is fitted to all of its detections: its side in units of the model against its side in
metres is the scale. Shapes: K detections of one marker.
"""

import collections
import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy import optimize

from nerf2real.core import least_squares
from nerf2real.core.geometry import cameras
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.alignment.lines import nearest_point

# Groups are tried in this order until one is read: the large sets contain the small ones. The time
# grows with the picture's size and with the number of codes.
DICTIONARIES = (
  ("4X4_50", "5X5_50", "6X6_50", "7X7_50"),
  ("APRILTAG_36h11", "APRILTAG_25h9", "APRILTAG_16h5", "ARUCO_MIP_36h12"),
  ("ARUCO_ORIGINAL", "4X4_1000", "5X5_250", "6X6_250", "7X7_250"),
)
_LOOKS = 60  # pictures in which all codes are tried; of a film's usual 150 no three in a row
# are without one
_MIN_VIEWS = 3  # a code read in fewer pictures is taken for an accident
_MIN_PARALLAX_DEG = 3.0  # between rays to the marker; less leaves its distance open
_MAX_ERROR_PX = 3.0  # of a detection against the fitted square
_MAX_UNSQUARENESS = 0.08  # spread of the triangulated sides; 16h5 and 4X4 are misread easily
_MIN_SIDE_PX = 10.0


class Detection(NamedTuple):
  """One marker seen in one picture."""

  dictionary: str
  marker: int
  view: int  # index of the picture
  corners: np.ndarray  # float64 [4, 2] pixels, COLMAP convention, clockwise


class MarkerScale(NamedTuple):
  """The scale found."""

  metres_per_unit: float
  spread: float  # relative standard deviation
  dictionary: str
  markers: tuple[int, ...]
  detections: int  # pictures that took part, over all markers
  error_px: float  # root mean square of the reprojected corners
  corners: np.ndarray  # [M, 4, 3] in the unit frame


def _detector(names: Sequence[str]) -> cv2.aruco.ArucoDetector:
  parameters = cv2.aruco.DetectorParameters()
  # Lines fitted to the edges' gradients. On the built-in room the scale is 0.02 % off with it, 0.6
  # % with CORNER_REFINE_SUBPIX and 1.9 % with CORNER_REFINE_CONTOUR: white outshines black.
  parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
  parameters.minMarkerPerimeterRate = 0.02  # of the picture's longer side: 10 px in 1920
  sets = []
  for name in names:
    code = getattr(cv2.aruco, f"DICT_{name}", None)
    if code is None:
      known = ", ".join(name for group in DICTIONARIES for name in group)
      raise ValueError(f'Unknown marker dictionary "{name}": take one of {known}.')
    sets.append(cv2.aruco.getPredefinedDictionary(code))
  return cv2.aruco.ArucoDetector(sets, parameters)


def _read(image: pathlib.Path | np.ndarray) -> np.ndarray:
  if isinstance(image, np.ndarray):
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
  gray = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)
  if gray is None:
    raise ValueError(f"Cannot read the picture {image}: it is missing or damaged.")
  return gray


def detect(
  images: Sequence[pathlib.Path | np.ndarray],
  *,
  dictionaries: Sequence[Sequence[str]] = DICTIONARIES,
  progress: Progress = no_progress,
) -> list[Detection]:
  """Finds markers in pictures (paths, or uint8 arrays [H, W] or [H, W, 3]).

  Which dictionaries there are is looked up in at most `_LOOKS` pictures, spread evenly. Those that
  were read there are then searched for in all pictures, a group at a time; the search ends with the
  first group of which one code is read in at least three pictures. Returns what that group, or else
  all of them, found.
  """
  looks = np.linspace(0, len(images) - 1, min(len(images), _LOOKS)).round().astype(int)
  everywhere = [name for group in dictionaries for name in group]

  def part_of(begin: float, end: float) -> Callable[[float], None]:
    return lambda done: progress(begin + done * (end - begin), "looking for markers")

  first = _search(images, looks, everywhere, part_of(0.0, 0.5))
  there = {d.dictionary for d in first}
  groups = [[name for name in group if name in there] for group in dictionaries]
  groups = [names for names in groups if names]
  ends = np.linspace(0.5, 1.0, len(groups) + 1)
  everything: list[Detection] = []
  for names, begin, end in zip(groups, ends[:-1], ends[1:], strict=True):
    found = _search(images, np.arange(len(images)), names, part_of(begin, end))
    everything += found
    views = collections.defaultdict(set)
    for d in found:
      views[d.dictionary, d.marker].add(d.view)
    if any(len(seen) >= _MIN_VIEWS for seen in views.values()):
      return found
  return everything


def _search(
  images: Sequence[pathlib.Path | np.ndarray],
  views: np.ndarray,
  names: Sequence[str],
  say: Callable[[float], None],
) -> list[Detection]:
  """Finds the markers of dictionaries in some of the pictures."""
  found: list[Detection] = []
  detector = _detector(names)
  for count, view in enumerate(views.tolist()):
    corners, ids, _, which = detector.detectMarkersMultiDict(_read(images[view]))
    if ids is not None:
      for quad, marker, index in zip(corners, np.ravel(ids), np.ravel(which), strict=True):
        quad = np.asarray(quad, np.float64).reshape(4, 2) + cameras.PIXEL_CENTRE
        if np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=-1).min() >= _MIN_SIDE_PX:
          found.append(Detection(names[int(index)], int(marker), view, quad))
    say((count + 1) / len(views))
  return found


def _square(parameters: np.ndarray) -> np.ndarray:
  """Corners [4, 3] of the square with a rotation vector, a centre and the logarithm of its side."""
  half = 0.5 * np.exp(parameters[6])
  flat = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float64)
  return flat @ cv2.Rodrigues(parameters[:3])[0].T + parameters[3:6]


def _fit_marker(
  detections: list[Detection], camera: cameras.Camera, frame_from_camera: np.ndarray
) -> tuple[float, float, np.ndarray, int, float] | None:
  """Fits a square: log side, deviation, corners, detections used, error [px]; or None."""
  kept = list(detections)
  for _ in range(4):
    if len({d.view for d in kept}) < _MIN_VIEWS:
      return None
    poses = frame_from_camera[[d.view for d in kept]]
    pixels = np.stack([d.corners for d in kept])  # [K, 4, 2]
    rays = np.einsum("kij,kcj->kci", poses[:, :3, :3], camera.rays(pixels))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    spread = np.degrees(np.arccos(np.clip(rays[:, 0] @ rays[:, 0].T, -1, 1))).max()
    if spread < _MIN_PARALLAX_DEG:
      return None
    corners = np.stack([nearest_point(poses[:, :3, 3], rays[:, c]) for c in range(4)])
    local = np.einsum("kji,kcj->kci", poses[:, :3, :3], corners[None] - poses[:, None, :3, 3])
    if (local[..., 2] <= 0).any():
      error = np.where((local[..., 2] <= 0).any(-1), np.inf, 0)
    else:
      error = np.linalg.norm(camera.project(local) - pixels, axis=-1).mean(-1)
    limit = max(_MAX_ERROR_PX, 3 * float(np.median(error)))
    if error.max() <= limit:
      break
    kept = [d for d, e in zip(kept, error, strict=True) if e <= limit and e < error.max()]
  sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=-1)
  if sides.std() > _MAX_UNSQUARENESS * sides.mean():
    return None

  x = corners[1] - corners[0] + corners[2] - corners[3]
  y = corners[0] - corners[3] + corners[1] - corners[2]
  x /= np.linalg.norm(x)
  y -= x * (x @ y)
  y /= np.linalg.norm(y)
  rotation = cv2.Rodrigues(np.stack([x, y, np.cross(x, y)], axis=1))[0].ravel()
  start = np.concatenate([rotation, corners.mean(0), [np.log(sides.mean())]])

  def residuals(parameters):
    world = _square(parameters)
    seen = np.einsum("kji,kcj->kci", poses[:, :3, :3], world[None] - poses[:, None, :3, 3])
    return (camera.project(seen) - pixels).ravel()

  fit = optimize.least_squares(residuals, start, loss="soft_l1", f_scale=0.5, x_scale="jac")
  error = residuals(fit.x)
  rms = float(np.sqrt(2 * np.mean(error**2)))  # of a corner, both axes
  if rms > _MAX_ERROR_PX:
    return None
  # The corners of one picture share its pose error: a picture counts as one observation.
  variance = 2 * np.mean(error**2) * 4
  spread = least_squares.standard_deviations(least_squares.covariance(fit.jac.T, variance=variance))
  return float(fit.x[6]), float(spread[6]), _square(fit.x), len(kept), rms


def marker_scale(
  detections: Sequence[Detection],
  *,
  camera: cameras.Camera,
  frame_from_camera: np.ndarray,
  side: float,
) -> MarkerScale | None:
  """Scale from detections of markers that all have the same side.

  Args:
    detections: From `detect`; `view` indexes the poses.
    camera: The camera of the pictures.
    frame_from_camera: Poses [N, 4, 4] in the unit frame.
    side: Side of a marker's black square [m].

  Returns:
    The scale, or None where no marker was read consistently in at least three pictures.
  """
  if side <= 0:
    raise ValueError(f"A marker's side must be positive, found {side} m.")
  groups: dict[tuple[str, int], list[Detection]] = {}
  for d in detections:
    groups.setdefault((d.dictionary, d.marker), []).append(d)
  fits: dict[str, list] = {}
  for (name, identifier), group in sorted(groups.items()):
    fit = _fit_marker(group, camera, frame_from_camera)
    if fit is not None:
      fits.setdefault(name, []).append((identifier, *fit))
  if not fits:
    return None
  name = max(fits, key=lambda n: sum(f[4] for f in fits[n]))
  markers = fits[name]
  logs, deviations = np.array([f[1] for f in markers]), np.array([f[2] for f in markers])
  weights = 1 / np.maximum(deviations, 1e-4) ** 2
  mean = float((weights * logs).sum() / weights.sum())
  spread = float(np.sqrt(1 / weights.sum()))
  if len(markers) > 1:  # markers that disagree say more than their own uncertainties
    spread = max(spread, float(np.sqrt((weights * (logs - mean) ** 2).sum() / weights.sum())))
  return MarkerScale(
    metres_per_unit=side / np.exp(mean),
    spread=spread,
    dictionary=name,
    markers=tuple(f[0] for f in markers),
    detections=sum(f[4] for f in markers),
    error_px=float(np.sqrt(np.mean([f[5] ** 2 for f in markers]))),
    corners=np.stack([f[3] for f in markers]),
  )
