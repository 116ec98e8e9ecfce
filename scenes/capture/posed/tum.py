"""RGB-D sequences in the layout of TUM's benchmark: lists of stamped pictures and a trajectory.

Source: Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems, and the page of its
file formats; ORB-SLAM, ETH3D and ICL-NUIM write pictures and depth into one list of associations.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.capture.media.errors import CaptureError
from nerf2real.scenes.capture.posed import trajectory
from nerf2real.scenes.capture.posed.recording import Recording, camera_of

_PICTURES, _DEPTH = "rgb.txt", "depth.txt"
_ASSOCIATIONS = ("associations.txt", "association.txt", "associate.txt", "associated.txt")
TRAJECTORY = "groundtruth.txt"
_POSES = (TRAJECTORY, "gt.txt", "trajectory.txt", "CameraTrajectory.txt")
_ICL = "[!.]*.gt.freiburg"  # ICL-NUIM's trajectories
_DEPTH_UNIT = 1 / 5000  # m


class _Listed(NamedTuple):
  """Pictures of a sequence and the depth picture that goes with each."""

  times: np.ndarray  # [N] of the pictures [s]
  files: list[Path]
  depth: list[Path]  # none, or one each
  depth_times: np.ndarray  # [N] [s], or empty
  without_depth: int = 0  # pictures that were left out, as no depth was measured near their time

  def selected(self, rows: np.ndarray) -> "_Listed":
    depth, depth_times = self.depth, self.depth_times
    if depth:
      depth, depth_times = [depth[k] for k in rows], depth_times[rows]
    files = [self.files[k] for k in rows]
    return _Listed(self.times[rows], files, depth, depth_times, self.without_depth)


def _first(source: Path, names: tuple[str, ...]) -> Path | None:
  return next((source / name for name in names if (source / name).is_file()), None)


def _poses_of(source: Path) -> Path | None:
  """The trajectory of a folder; None where there is none."""
  return _first(source, _POSES) or next(iter(sorted(source.glob(_ICL))), None)


def is_tum(source: Path) -> bool:
  """Whether a folder holds lists of pictures and poses in TUM's layout."""
  return _first(source, (_PICTURES, *_ASSOCIATIONS)) is not None and _poses_of(source) is not None


def lists_without_poses(source: Path) -> str | None:
  """Names the list of pictures of a folder that has no trajectory beside it; None where none is."""
  listed = _first(source, (_PICTURES, *_ASSOCIATIONS))
  return None if listed is None or is_tum(source) else listed.name


def _table(path: Path, columns: int) -> list[list[str]]:
  """Rows of a text file of TUM's: words, without comments."""
  try:
    text = path.read_text(encoding="utf-8")
  except UnicodeDecodeError as error:
    raise CaptureError(f"{path} is no text in UTF-8 ({error}): save it as such.") from error
  lines = (line.strip() for line in text.replace(",", " ").splitlines())
  rows = [line.split(maxsplit=columns - 1) for line in lines if line[:1] not in ("", "#")]
  if not rows or any(len(row) < columns for row in rows):
    raise CaptureError(f"{path} is no list of TUM's layout: expected {columns} columns a line.")
  return rows


def _stamped(path: Path, words: list[str]) -> np.ndarray:
  """Times [s] of a column."""
  try:
    return np.array([float(word) for word in words])
  except ValueError as error:
    raise CaptureError(f"{path}: a time or pose is no number ({error}).") from error


def _listed(source: Path) -> _Listed:
  """Pictures and depth pictures of a sequence; those without depth are left out where there is."""
  path = source / _PICTURES
  if path.is_file():
    rows = _table(path, 2)
    times = _stamped(path, [row[0] for row in rows])
    files = [source / row[1] for row in rows]
    if not (source / _DEPTH).is_file():
      return _Listed(times, files, [], np.zeros(0))
    listed = _table(source / _DEPTH, 2)
    stamps = _stamped(source / _DEPTH, [row[0] for row in listed])
    index, near = trajectory.nearest(stamps, times)
    if not near.any():
      return _Listed(times, files, [], np.zeros(0), without_depth=len(times))
    depth = [source / listed[k][1] for k in index]
    found = _Listed(times, files, depth, stamps[index], without_depth=int((~near).sum()))
    return found.selected(np.flatnonzero(near))
  joint = _first(source, _ASSOCIATIONS)
  assert joint is not None  # `is_tum` has found one
  pairs = [row[:3] + row[3].split()[:1] for row in _table(joint, 4)]
  if all("depth" in row[1].lower() for row in pairs):  # ICL-NUIM lists the depth first
    pairs = [row[2:] + row[:2] for row in pairs]
  times, depth_times = (_stamped(joint, [row[k] for row in pairs]) for k in (0, 2))
  files, depth = ([source / row[k] for row in pairs] for k in (1, 3))
  return _Listed(times, files, depth, depth_times)


def read_tum(source: Path) -> Recording:
  """Reads a folder of TUM's layout; pictures without a pose or depth are left out.

  Raises:
    CaptureError: A list is damaged, or no picture has a pose and, where there is depth, depth.
  """
  listed = _listed(source)
  path = _poses_of(source)
  assert path is not None  # `is_tum` has found one
  words = [row[:7] + row[7].split()[:1] for row in _table(path, 8)]
  values = np.stack([_stamped(path, list(column)) for column in zip(*words, strict=True)], -1)
  poses, known = trajectory.poses_at(values, listed.times)
  if not known.any():
    raise CaptureError(
      f"{source}: no picture has a pose within {trajectory.SAME_TIME:g} s: expected pictures, "
      f"depth and {path.name} of one recording."
    )
  chosen = listed.selected(np.flatnonzero(known))
  depth_poses = None
  if chosen.depth:
    measured, timely = trajectory.poses_at(values, chosen.depth_times)
    depth_poses = np.where(timely[:, None, None], measured, poses[known])
  found = Recording(
    files=chosen.files,
    poses=poses[known],
    depth=chosen.depth,
    depth_poses=depth_poses,
    unit=_DEPTH_UNIT,
  ).present(source)
  if listed.without_depth:
    near = f"pictures have no depth within {trajectory.SAME_TIME:g} s"
    of = len(listed.files) + (listed.without_depth if listed.depth else 0)
    fate = "left out" if listed.depth else f"none of {_DEPTH} used"
    found = found.warned(f"{listed.without_depth} of {of} {near}: {fate}.")
  lost = len(listed.files) - len(chosen.files)
  if lost:
    found = found.warned(f"{lost} of {len(listed.files)} pictures have no pose: left out.")
  return camera_of(found, source, focal=525.0, what="TUM's")
