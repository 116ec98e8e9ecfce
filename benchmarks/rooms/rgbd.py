"""The built-in room as a depth camera's recording with known poses: a scene from it, measured.

  python benchmarks/rooms/rgbd.py --work out/rgbd --layout tum --preset fast --keyframes 100
  python benchmarks/rooms/rgbd.py --work out/kinect --layout 7scenes --preset tiny

The pictures are the shipped film's, 640x480. Depth is the truth's with the noise, the range and the
holes of a structured-light sensor, poses err as a tracker's do. TUM's layout has depth as its tools
leave it, in the pixels of the pictures, and says what its camera is. 7-Scenes' has it as a Kinect
measures it: by a second camera beside the first one, of another focal length, whose poses are
given; nothing says what the cameras are.
"""

import dataclasses
import time
from pathlib import Path
from typing import Literal

import av
import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks import harness
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes import pipeline
from nerf2real.scenes.builtin import filming, ground_truth, room
from nerf2real.scenes.settings import preset
from nerf2real.scenes.stages.results import Reconstruction, TruthFigures

_NEAR, _FAR = 0.4, 4.5  # range of the sensor [m]
_NOISE = 0.0015  # standard deviation at 1 m, growing with the square [m]; Khoshelham 2012: 1.4 mm
_HOLES = 0.2  # share of the picture without depth
_HOLE_SIZE = 12.0  # pixels that a hole is wide
_POSITION_ERROR = 0.01  # of a tracker, root mean square [m]
_ROTATION_ERROR = np.radians(0.5)  # of a tracker, root mean square [rad]
_DRIFT = 2 / 3  # s over which a tracker's errors change
_RATE = 30.0  # frames a second of the stamps
TUM_UNIT = 1 / 5000  # m that one count of its depth is
# Kinect: 7-Scenes' nominal depth camera, 25 mm beside a colour camera of shorter focal length
_SENSOR = Camera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
_BESIDE = 0.025  # m along the colour camera's x axis
_COLOUR_FOCAL = 525.0  # pixels: the film's pictures are enlarged to it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to record and to measure."""

  work: Path
  """Folder of the recording and of the bundle."""
  layout: Literal["tum", "7scenes"] = "tum"
  """Whose files, and whose depth."""
  frames: int = 1000
  """Of the recording, spread evenly over the film."""
  keyframes: int | None = None
  """Pictures to take from it; the preset's number if not given."""
  preset: str = "tiny"
  """Preset of the scene."""
  seed: int = 0
  """Of noise, holes and the poses' errors."""


def tracked(poses: np.ndarray, rng: np.random.Generator, *, rate: float = _RATE) -> np.ndarray:
  """Poses [N, 4, 4] with the smooth errors of a tracker, without drift; `rate` of them a second."""
  errors = ndimage.gaussian_filter1d(rng.standard_normal((len(poses), 6)), _DRIFT * rate, axis=0)
  errors /= np.sqrt(np.mean(errors**2, axis=0))
  result = poses.copy()
  result[:, :3, 3] += _POSITION_ERROR / np.sqrt(3) * errors[:, :3]
  turns = Rotation.from_rotvec(_ROTATION_ERROR / np.sqrt(3) * errors[:, 3:]).as_matrix()
  result[:, :3, :3] = turns @ result[:, :3, :3]
  return result


def sensed(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
  """True z-depth [H, W] [m] as a structured-light sensor measures it; 0 where it does not."""
  noisy = depth + _NOISE * depth**2 * rng.standard_normal(depth.shape)
  lumps = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), _HOLE_SIZE)
  missing = lumps < np.quantile(lumps, _HOLES)
  return np.where((noisy > _NEAR) & (noisy < _FAR) & ~missing, noisy, 0.0)


def enlarged(picture: np.ndarray, factor: float) -> np.ndarray:
  """The middle of a picture [H, W, 3], enlarged to its size."""
  height, width = picture.shape[:2]
  large = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
  top, left = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
  return large[top : top + height, left : left + width]


def record(folder: Path, settings: Settings) -> np.ndarray:
  """Writes the recording; returns the true poses [N, 4, 4] of the colour camera."""
  truth = filming.read_truth(ground_truth.TRUTH)
  rng = np.random.default_rng([settings.seed, 10])
  wanted = np.linspace(0, len(truth["world_from_camera"]) - 1, settings.frames).astype(int)
  poses = truth["world_from_camera"][wanted]
  beside = np.eye(4)
  beside[0, 3] = _BESIDE
  apart = settings.layout == "7scenes"
  sensor, sensor_poses = (_SENSOR, poses @ beside) if apart else (truth["camera"], poses)
  given = tracked(sensor_poses, rng)
  unit = 1e-3 if apart else TUM_UNIT
  for name in () if apart else ("rgb", "depth"):
    (folder / name).mkdir(parents=True, exist_ok=True)
  folder.mkdir(parents=True, exist_ok=True)
  row = {int(index): k for k, index in enumerate(wanted)}
  with room.room_eye() as eye, av.open(str(ground_truth.VIDEO)) as container:
    for index, frame in enumerate(container.decode(video=0)):
      if index not in row:
        continue
      k = row[index]
      depth = sensed(eye.render(sensor, sensor_poses[k], supersample=1)[1], rng)
      raw = np.rint(depth / unit).astype(np.uint16)
      picture = frame.to_ndarray(format="bgr24")
      if apart:
        picture = enlarged(picture, _COLOUR_FOCAL / truth["camera"].fx)
        raw[raw == 0] = 65535
        names = [f"frame-{k:06d}.{kind}.png" for kind in ("color", "depth")]
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", given[k])
      else:
        names = [f"{kind}/{k:06d}.png" for kind in ("rgb", "depth")]
      for name, content in zip(names, (picture, raw), strict=True):
        cv2.imwrite(str(folder / name), content, [cv2.IMWRITE_PNG_COMPRESSION, 1])
  if not apart:
    write_lists(folder, given, truth["camera"])
  return poses


def write_lists(folder: Path, poses: np.ndarray, camera: Camera, *, rate: float = _RATE) -> None:
  """Writes TUM's lists and trajectory, and the camera; `rate` poses [N, 4, 4] a second."""
  times = 1000 + np.arange(len(poses)) / rate
  for kind in ("rgb", "depth"):
    rows = [f"{t:.4f} {kind}/{k:06d}.png\n" for k, t in enumerate(times)]
    (folder / f"{kind}.txt").write_text("".join(rows))
  values = np.c_[times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()]
  np.savetxt(folder / "groundtruth.txt", values, fmt="%.6f")
  cx, cy = camera.opencv_matrix[:2, 2]
  lens = [camera.fx, camera.fy, cx, cy, *camera.distortion]
  np.savetxt(folder / "calibration.txt", [lens], fmt="%.6f")


def make_scene(folder: Path, poses: np.ndarray, settings: Settings) -> dict[str, harness.Value]:
  """Makes a scene of the recording and measures it against the truth."""

  def measure(result: Reconstruction) -> TruthFigures:
    rows = [int(Path(name).stem.split("_")[-1]) for name in result.localisation.names]
    return ground_truth.compare(result, poses[rows])

  used = preset(settings.preset)
  if settings.keyframes is not None:
    taken = dataclasses.replace(used.capture, num_keyframes=settings.keyframes)
    used = dataclasses.replace(used, capture=taken)
  began, spent = time.perf_counter(), time.process_time()
  made = pipeline.make_scene(folder, settings.work / "scene", settings=used, measure=measure)
  names = ["registered_fraction", "held_out_psnr_db", "robot_psnr_db", "camera_rmse_m"]
  names += ["collision_true_within_5cm", "collision_true_p95_m", "surface_true_within_5cm"]
  names += ["free_area_m2", "scale_error", "sight_lines_blocked"]
  figures: dict[str, harness.Value] = {name: float(made.figures[name]) for name in names}
  for warning in made.scene["warnings"]:
    print("warning:", warning)
  figures["wall_time_s"] = time.perf_counter() - began
  figures["processor_s"] = time.process_time() - spent
  return figures


def main(settings: Settings) -> None:
  """Records, makes the scene and prints."""
  folder = settings.work / "recording"
  poses = record(folder, settings)
  figures = {f"scene_of_{settings.layout}": make_scene(folder, poses, settings)}
  harness.finish("rgbd", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
