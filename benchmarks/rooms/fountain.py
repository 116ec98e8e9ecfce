"""Localisation against surveyed poses: fountain-P11.

  python benchmarks/rooms/fountain.py --data ../shared/data/captures/fountain-P11

Source of the data: Strecha et al. 2008, On benchmarking camera calibration and multi-view stereo
for high resolution imagery. Exit code 1 if a figure is missed.
"""

import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import harness
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.structure_from_motion import localise

MAX_POSITION_RMSE = 0.01  # [m]
MAX_ROTATION_RMSE = 0.1  # [degree]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Where the data is."""

  data: Path
  """Folder of fountain-P11, with images/ and gt_dense_cameras/."""


@dataclasses.dataclass(frozen=True)
class PoseErrors:
  """Errors of poses [N] after the best similarity and one constant rotation in the camera frame."""

  position: np.ndarray
  """[N], unit of the truth."""
  rotation: np.ndarray
  """[N] [degree]."""

  @property
  def position_rmse(self) -> float:
    """Root mean square of the position errors."""
    return float(np.sqrt(np.mean(self.position**2)))

  @property
  def rotation_rmse(self) -> float:
    """Root mean square of the rotation errors [degree]."""
    return float(np.sqrt(np.mean(self.rotation**2)))


def pose_errors(estimated: np.ndarray, truth: np.ndarray) -> PoseErrors:
  """Compares world-from-camera poses [N, 4, 4] up to a similarity.

  The constant rotation between the camera frames takes up the principal point, which pictures alone
  hardly determine: moving it turns all cameras by the same angle.
  """
  fit = Similarity.fit(estimated[:, :3, 3], truth[:, :3, 3])
  aligned = fit.apply_pose(estimated)
  difference = Rotation.from_matrix(np.swapaxes(aligned[:, :3, :3], 1, 2) @ truth[:, :3, :3])
  return PoseErrors(
    position=np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1),
    rotation=np.degrees((difference * difference.mean().inv()).magnitude()),
  )


def read_truth(folder: Path) -> tuple[list[str], np.ndarray]:
  """Reads the surveyed cameras: names and world-from-camera poses [N, 4, 4] [m]."""
  names, poses = [], []
  for path in sorted(folder.glob("*.camera")):
    rows = [[float(value) for value in line.split()] for line in path.read_text().splitlines()]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rows[4:7], rows[7]
    names.append(path.name.removesuffix(".camera"))
    poses.append(pose)
  if not names:
    raise FileNotFoundError(f"{folder} holds no .camera files: give the folder of fountain-P11.")
  return names, np.stack(poses)


def measure(data: Path, work: Path) -> tuple[PoseErrors, Localisation, float]:
  """Localises the pictures; returns errors, the localisation and the seconds it took."""
  start = time.perf_counter()
  capture = read_capture(data / "images", work / "keyframes")
  result = localise(work / "keyframes", work)
  seconds = time.perf_counter() - start
  _, truth = read_truth(data / "gt_dense_cameras")
  rows = [[path.name for path in capture.images].index(name) for name in result.names]
  return pose_errors(result.world_from_camera, truth[rows]), result, seconds


def main(settings: Settings) -> int:
  """Measures and prints; returns 1 if a figure is missed."""
  with tempfile.TemporaryDirectory() as folder:
    errors, result, seconds = measure(settings.data, Path(folder))
  figures: dict[str, harness.Value] = {
    "registered_percent": 100 * result.registered_fraction,
    "position_rmse_mm": 1e3 * errors.position_rmse,
    "position_largest_mm": 1e3 * float(errors.position.max()),
    "rotation_rmse_degrees": errors.rotation_rmse,
    "rotation_largest_degrees": float(errors.rotation.max()),
    "reprojection_error_px": result.reprojection_error_px,
    "wall_time_s": seconds,
  }
  limits = {
    "position_rmse_mm": 1e3 * MAX_POSITION_RMSE,
    "rotation_rmse_degrees": MAX_ROTATION_RMSE,
    "rotation_largest_degrees": MAX_ROTATION_RMSE,
  }
  missed = [name for name, limit in limits.items() if float(figures[name]) > limit]  # type: ignore[arg-type]
  missed += ["registered_percent"] * (result.registered_fraction < 1)
  words = f"{result.strategy}; missed: {', '.join(missed) or 'nothing'}"
  harness.finish("fountain", {"poses": figures}, settings, words=words)
  return 1 if missed else 0


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
