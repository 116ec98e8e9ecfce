"""Films the built-in room as a hand-held phone would, and writes down the truth."""

import dataclasses
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from nerf2real.core import files
from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.core.serialization import from_plain, to_plain, write_json
from nerf2real.scenes.builtin import camera_path, furniture, room
from nerf2real.scenes.builtin.mujoco_renderer import Eye
from nerf2real.scenes.builtin.placing import ROOM_SIZE

TRUTH_VERSION = 1
_CHROMA_OFFSET = -8  # finer colour: with 4:2:0 it, not brightness, limits the error
SHIPPED_VIDEO = Path(__file__).parent / "data" / "room.mp4"  # its truth is beside it
LENS = Camera(
  width=640,
  height=480,
  fx=498.0,
  fy=499.1,
  cx=322.3,
  cy=237.6,
  k1=0.06,
  k2=-0.09,
  p1=0.0006,
  p2=-0.0004,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FilmSettings:
  """Settings of the film's walk, camera and file."""

  camera: Camera = LENS
  """The phone's lens and picture size."""
  seconds: float = 70.0
  """Length of the film [s]."""
  frame_rate: float = 15.0
  """Pictures a second."""
  exposure: float = 1 / 80
  """Time that the shutter is open; moving during it blurs the picture [s]."""
  subframes: int = 3
  """Instants averaged over the exposure."""
  supersample: int = 2
  """Samples a pixel along each side, at each instant."""
  lens_blur: float = 0.55
  """Standard deviation of the lens's own blur [pixel]."""
  read_noise: float = 0.5
  """Standard deviation of the sensor's noise in black [grey level of 255]."""
  shot_noise: float = 0.02
  """Variance of the noise per grey level."""
  shake_position: float = 0.006
  """Standard deviation of the hand's shake [m]."""
  shake_angle: float = 0.007
  """Standard deviation of the hand's shake [rad]."""
  quality: float = 25.0
  """x264's constant rate factor; smaller is better and larger. Measured against the pictures
  without noise, 25 gives 35.8 dB (40 dB in brightness) at 80 kB a second."""
  speed: str = "slow"
  """x264's preset."""

  @property
  def frames(self) -> int:
    """Number of pictures."""
    return max(round(self.seconds * self.frame_rate), 1)


def shoot(seed: int, settings: FilmSettings) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
  """Yields each picture of the film.

  Yields:
    The noisy picture uint8 [H, W, 3], the same without noise float32 [H, W, 3], and the pose at the
    middle of the exposure, world_from_camera [4, 4].
  """
  path = camera_path.Walk(
    seed,
    seconds=settings.seconds,
    shake_position=settings.shake_position,
    shake_angle=settings.shake_angle,
  )
  rng = np.random.default_rng([seed, 5])
  with room.room_eye(seed) as eye:
    for index in range(settings.frames):
      middle = min((index + 0.5) / settings.frame_rate, settings.seconds)
      picture = exposed(eye, path, middle, settings)
      yield with_noise(picture, settings, rng), picture, path.pose(np.array([middle]))[0]


def exposed(
  eye: Eye, path: camera_path.HandHeld, middle: float, settings: FilmSettings
) -> np.ndarray:
  """Returns what falls on the sensor while the shutter is open, float32 [H, W, 3].

  Args:
    eye: Of the room.
    path: Of the camera.
    middle: Of the exposure [s].
    settings: Of the film.
  """
  offsets = ((np.arange(settings.subframes) + 0.5) / settings.subframes - 0.5) * settings.exposure
  picture: Any = np.zeros((settings.camera.height, settings.camera.width, 3), np.float32)
  for pose in path.pose(middle + offsets):
    picture += eye.render(settings.camera, pose, supersample=settings.supersample)[0]
  picture /= settings.subframes
  return cv2.GaussianBlur(picture, (0, 0), settings.lens_blur) if settings.lens_blur else picture


def with_noise(picture: np.ndarray, settings: FilmSettings, rng: np.random.Generator) -> np.ndarray:
  """Returns what the sensor reads of a picture, uint8 [H, W, 3]."""
  deviation = np.sqrt(settings.read_noise**2 + settings.shot_noise * picture)
  noisy = picture + deviation * rng.standard_normal(picture.shape, np.float32)
  return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def encode(path: Path, pictures: Iterable[np.ndarray], settings: FilmSettings) -> None:
  """Writes pictures uint8 [H, W, 3] to an .mp4 file (H.264)."""
  with av.open(str(path), "w") as container:
    stream = container.add_stream("libx264", rate=round(settings.frame_rate))
    stream.width, stream.height = settings.camera.width, settings.camera.height
    stream.pix_fmt = "yuv420p"
    stream.options = {
      "crf": str(settings.quality),
      "preset": settings.speed,
      "g": "150",
      "tune": "psnr",
      "x264-params": f"chroma-qp-offset={_CHROMA_OFFSET}",
    }
    for picture in pictures:
      container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    container.mux(stream.encode())


def film(
  out_video: Path,
  *,
  seed: int = 0,
  settings: FilmSettings | None = None,
  truth_path: Path | None = None,
  progress: Progress = no_progress,
) -> None:
  """Writes the film and its truth; nothing is left behind under their names unless whole.

  Args:
    out_video: The .mp4 file (H.264).
    seed: Seed of the room, the path and the noise.
    settings: How to film.
    truth_path: The truth's JSON file; beside the video if None: name_truth.json.
    progress: Called with the fraction done and a text.
  """
  settings = settings or FilmSettings()
  out_video = Path(out_video)
  truth_path = Path(truth_path or out_video.with_name(f"{out_video.stem}_truth.json"))
  out_video.parent.mkdir(parents=True, exist_ok=True)
  truth_path.parent.mkdir(parents=True, exist_ok=True)
  poses = []

  def pictures() -> Iterator[np.ndarray]:
    for index, (noisy, _, pose) in enumerate(shoot(seed, settings)):
      yield noisy
      poses.append(pose)
      done = index + 1
      progress(done / settings.frames, f"picture {done} of {settings.frames}")

  with files.atomic_path(out_video) as partial, files.atomic_path(truth_path) as partial_truth:
    encode(partial, pictures(), settings)
    write_json(partial_truth, truth(seed, settings, np.array(poses)), indent=None)


def truth(seed: int, settings: FilmSettings, world_from_camera: np.ndarray) -> dict:
  """Returns the film's ground truth as plain numbers; poses are [T, 4, 4]."""
  plain = to_plain(settings)
  return {
    "version": TRUTH_VERSION,
    "seed": seed,
    "frame": "world: z up, floor z = 0, metres; camera axes of OpenCV; pose in mid exposure",
    "frame_rate": settings.frame_rate,
    "settings": {name: value for name, value in plain.items() if name != "camera"},
    "camera": plain["camera"],
    "marker": {
      "dictionary": "DICT_4X4_50",
      "id": furniture.MARKER_ID,
      "size": furniture.MARKER_SIZE,
      "corners": furniture.marker_corners().tolist(),
    },
    "room_size": list(ROOM_SIZE),
    "free_area": [list(corner) for corner in furniture.FREE_AREA],
    "world_from_camera": np.round(world_from_camera[:, :3], 7).tolist(),
  }


def read_truth(path: Path) -> dict:
  """Reads a film's truth: camera (Camera), world_from_camera [T, 4, 4], marker corners [4, 3]."""
  values = json.loads(Path(path).read_text())
  if values.get("version") != TRUTH_VERSION:
    raise ValueError(
      f"{path}: truth of version {values.get('version')}, expected {TRUTH_VERSION}. Film it again."
    )
  poses = np.tile(np.eye(4), (len(values["world_from_camera"]), 1, 1))
  poses[:, :3] = values["world_from_camera"]
  values["world_from_camera"] = poses
  values["camera"] = from_plain(values["camera"], Camera, source=path)
  values["marker"]["corners"] = np.array(values["marker"]["corners"])
  return values
