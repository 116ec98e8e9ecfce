"""The built-in room as a hand-held depth camera records it, in TUM's layout: a scene, measured.

  python benchmarks/rooms/hand_held.py --work out/hand --no-scene
  python launch/make_scene.py --capture out/hand/recording --out out/hand/scene
  python benchmarks/rooms/hand_held.py --work out/hand --no-record

1,000 pictures of 640x480 at 30 Hz, walked at 0.4 m/s, with the noise and the blur of such a camera.
Its depth has a clock of its own: the nearest depth picture is up to 17 ms from a picture. Some
pictures of both were dropped. The trajectory has 100 poses a second with a tracker's errors and a
gap. Nothing says what the camera is; its lens is not the data set's nominal one. The last command
reads the scene that the second one made, and adds what the true room says of it.
"""

import dataclasses
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import harness
from benchmarks.rooms import rgbd
from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes import pipeline
from nerf2real.scenes.builtin import camera_path, ground_truth, room
from nerf2real.scenes.capture.posed.tum import read_tum
from nerf2real.scenes.settings import preset, with_steps
from nerf2real.scenes.stages.results import Reconstruction, TruthFigures

# TUM's freiburg1 has this focal length and principal point, and a stronger distortion.
_CAMERA = Camera(
  width=640,
  height=480,
  fx=517.3,
  fy=516.5,
  cx=318.6,
  cy=255.3,
  k1=0.1,
  k2=-0.2,
  p1=-0.002,
  p2=0.001,
)
_WALK = 70.0  # s of the whole walk, of which the recording is a part
_BEGIN = 1.0  # s into the walk
_CLOCK = 1305031102.0  # stamp of the walk's beginning [s]
_RATE, _DEPTH_RATE = 30.0, 29.98  # pictures a second
_DEPTH_LATE = 0.009  # s of the first depth picture after the first picture
_DROPPED = {"rgb": 0.01, "depth": 0.03}  # share of the pictures that were not written
_POSE_RATE = 100.0  # poses a second
_LEAD = 0.8  # s that the trajectory is longer at both ends
_GAP = (14.0, 14.6)  # s into the walk: the tracker has lost the camera
_EXPOSURE = 1 / 60  # s
_SUBFRAMES = 2  # instants averaged over it
_LENS_BLUR = 0.6  # pixels
_NOISE = 2.5  # grey levels
_UNIT = 1 / 5000  # m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to record and to measure."""

  work: Path
  """Folder of the recording and of the bundle."""
  frames: int = 1000
  """Pictures of the recording."""
  preset: str = "fast"
  """Preset of the scene."""
  train_steps: int | None = None
  """Of the training; as many as the preset's time allows for None."""
  record: bool = True
  """Make the recording; otherwise it is there."""
  scene: bool = True
  """Make the scene, or read the one that is there, and measure it."""
  seed: int = 0
  """Of the path, the noise, what was dropped and the poses' errors."""


def _walk(seed: int) -> camera_path.Walk:
  return camera_path.Walk(seed, seconds=_WALK)


def _photograph(eye, walk: camera_path.Walk, when: float, rng: np.random.Generator) -> np.ndarray:
  """Picture uint8 [H, W, 3], BGR, blurred by the hand, with noise."""
  instants = when + ((np.arange(_SUBFRAMES) + 0.5) / _SUBFRAMES - 0.5) * _EXPOSURE
  views = [eye.render(_CAMERA, pose, supersample=1)[0] for pose in walk.pose(instants)]
  clean = cv2.GaussianBlur(np.mean(views, axis=0, dtype=np.float32), (0, 0), _LENS_BLUR)
  picture = clean + _NOISE * rng.standard_normal(clean.shape, np.float32)
  return np.clip(np.rint(picture), 0, 255).astype(np.uint8)[..., ::-1]


def record(folder: Path, settings: Settings) -> None:
  """Writes the recording: pictures, depth, their lists, the trajectory."""
  rng = np.random.default_rng([settings.seed, 11])
  walk = _walk(settings.seed)
  number = np.arange(settings.frames)
  times = {"rgb": _BEGIN + number / _RATE, "depth": _BEGIN + _DEPTH_LATE + number / _DEPTH_RATE}
  with room.room_eye(settings.seed) as eye:
    for kind, all_times in times.items():
      (folder / kind).mkdir(parents=True, exist_ok=True)
      rows = [f"# {kind} images", "# timestamp filename"]
      for when in all_times[rng.random(settings.frames) >= _DROPPED[kind]]:
        name = f"{kind}/{_CLOCK + when:.6f}.png"
        if kind == "rgb":
          picture = _photograph(eye, walk, when, rng)
        else:
          depth = eye.render(_CAMERA, walk.pose(np.array([when]))[0], supersample=1)[1]
          picture = np.rint(rgbd.sensed(depth, rng) / _UNIT).astype(np.uint16)
        cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        rows.append(f"{_CLOCK + when:.6f} {name}")
      (folder / f"{kind}.txt").write_text("\n".join(rows) + "\n")
  _write_trajectory(folder / "groundtruth.txt", walk, times["rgb"], rng)


def _write_trajectory(
  path: Path, walk: camera_path.Walk, times: np.ndarray, rng: np.random.Generator
) -> None:
  """Writes the tracker's poses from before the first of the pictures' times to after the last."""
  when = np.arange(times[0] - _LEAD, times[-1] + _LEAD, 1 / _POSE_RATE)
  poses = rgbd.tracked(walk.pose(when), rng, rate=_POSE_RATE)
  values = np.c_[_CLOCK + when, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()]
  values = values[(when < _GAP[0]) | (when > _GAP[1])]
  header = "ground truth trajectory\ntimestamp tx ty tz qx qy qz qw"
  np.savetxt(path, values, fmt=["%.4f"] + 7 * ["%.6f"], header=header)


def make_scene(folder: Path, settings: Settings) -> dict[str, harness.Value]:
  """Makes a scene of the recording, or reads it, and measures it against the truth."""
  files = read_tum(folder).files

  def measure(result: Reconstruction) -> TruthFigures:
    rows = [int(Path(name).stem.split("_")[-1]) for name in result.localisation.names]
    when = np.array([float(files[row].stem) for row in rows]) - _CLOCK
    return ground_truth.compare(result, _walk(settings.seed).pose(when))

  used = with_steps(preset(settings.preset), settings.train_steps)
  spent = time.process_time()
  made = pipeline.make_scene(folder, settings.work / "scene", settings=used, measure=measure)
  names = ["registered_fraction", "held_out_psnr_db", "robot_psnr_db", "camera_rmse_m"]
  names += ["camera_rotation_deg", "collision_true_within_5cm", "collision_true_p95_m"]
  names += ["surface_true_within_5cm", "free_area_m2", "scale_error", "sight_lines_blocked"]
  figures: dict[str, harness.Value] = {name: float(made.figures[name]) for name in names}
  for warning in made.scene["warnings"]:
    print("warning:", warning)
  figures |= {f"{stage}_s": float(took) for stage, took in made.scene["seconds"].items()}
  return figures | {"processor_s": time.process_time() - spent}


def main(settings: Settings) -> None:
  """Records, makes the scene and prints."""
  folder = settings.work / "recording"
  if settings.record:
    record(folder, settings)
  if settings.scene:
    figures = {"scene_of_tum": make_scene(folder, settings)}
    harness.finish("hand_held", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
