"""Photographs of the built-in room: a scene from few of them, and the cost of large ones.

  python benchmarks/rooms/stills.py --work out/stills --preset tiny
  python benchmarks/rooms/stills.py --work out/stills --megapixels 12 48 --no-scene
  python benchmarks/rooms/stills.py --work out/thing --subject thing --count 50
  python benchmarks/rooms/stills.py --work out/mixed --mixed

The photographer stands along the furniture and looks across the room, two thirds of the pictures
from eye height, the others from knee height, every third one upright; the phone sets each one's
exposure. Of other subjects all pictures look at one thing: a pouf from half around it, the floor
below it; or a bookcase from before it, without any floor. The files are JPEGs of a phone's size
with EXIF's orientation and focal length; their content is as sharp as 1920x1440. Memory is the peak
of a process of its own.

`--mixed` makes of the same photographs a folder as people send it: some as PNG without EXIF, some
reduced by a messenger, some of a second lens, some blurred by the hand, one of another room, one a
copy, exposures that differ more.
"""

import dataclasses
import multiprocessing
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image

from benchmarks import harness
from nerf2real.core.geometry.rotations import camera_axes
from nerf2real.scenes import pipeline
from nerf2real.scenes.builtin import filming, ground_truth, room
from nerf2real.scenes.capture.capture import CaptureSettings
from nerf2real.scenes.capture.media import stills
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses.matching import features
from nerf2real.scenes.settings import preset, with_marker, with_steps
from nerf2real.scenes.stages.results import Reconstruction, TruthFigures

_LENS = filming.LENS.resized(1920, 1440)
_MILLIMETRES = round(36 * _LENS.fx / _LENS.width)  # EXIF's focal length, for film of 36 mm width
_RING = (0.32, -0.17), (1.3, 1.2)  # centre and radii of the walk along the furniture [m]
_HEIGHTS, _PITCHES = (1.5, 0.6), (0.38, 0.15)  # m, rad downwards
# place looked at [m], radii of the arc [m], its first and last angle [rad], heights [m]
_THINGS = {
  "thing": ((-1.62, -0.66, 0.25), (1.1, 1.1), (-1.4, 1.5), (1.2, 0.8)),
  "front": ((0.0, -1.86, 1.3), (1.4, 2.2), (0.7, 2.4), (1.5, 1.3)),
}
_SWAY, _TURN = 0.3, 0.03  # rad: looking left and right in turn; how crookedly a phone is held
_STEP_ASIDE = 0.05  # standard deviation of a place [m]
_EXPOSURE = 0.1, 0.3  # standard deviation of the logarithm of the exposure; in a mixed folder
# of a phone held upright: the sensor's x is down, its y is left
UPRIGHT_FROM_SENSOR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_QUALITY = 92  # of the JPEG files
_ASPECT = 4 / 3
_READ = 8  # files that are read for a time
# In a mixed folder, picture k of every ten: what became of it.
_FATES = {1: "png", 3: "reduced", 5: "blurred", 8: "second lens"}
_STRANGER = 12  # picture of another room
_REDUCED = 1600  # long side that a messenger leaves [pixel]
_BLUR = 24  # pixels that the hand moves in a blurred picture of 1920
_SECOND_LENS = 1.3  # focal length, times the first one's


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """What to photograph and to measure."""

  work: Path
  """Folder of the pictures and of the bundle."""
  count: int = 35
  """Photographs of the room."""
  megapixels: tuple[float, ...] = (12.0,)
  """Sizes of the files; the scene is made of the first, of others a few are read for a time."""
  subject: Literal["room", "thing", "front"] = "room"
  """What is photographed."""
  mixed: bool = False
  """Whether the folder is one as people send it."""
  preset: str = "tiny"
  """Preset of the scene."""
  train_steps: int | None = None
  """Of the training; as many as the preset's time allows for None."""
  scene: bool = True
  """Make a scene, and measure it against the truth."""
  seed: int = 0
  """Of places and noise."""


def _ring(count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
  """Yields places [3] along the furniture and the directions [3] across the room."""
  centre, radii = (np.array(pair) for pair in _RING)
  high = round(count * 2 / 3)
  for k in range(count):
    ring, number, of = (0, k, high) if k < high else (1, k - high, count - high)
    angle = 2 * np.pi * number / of
    heading, pitch = angle + np.pi + _SWAY * (-1) ** k, _PITCHES[ring]
    level = np.cos(pitch)
    place = np.array([*(centre + radii * [np.cos(angle), np.sin(angle)]), _HEIGHTS[ring]])
    yield place, np.array([level * np.cos(heading), level * np.sin(heading), -np.sin(pitch)])


def _arc(count: int, subject: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
  """Yields places [3] on an arc around a thing and the directions [3] to it."""
  focus, radii, ends, heights = _THINGS[subject]
  for k, angle in enumerate(np.linspace(*ends, count)):
    reach = radii[0] + (radii[1] - radii[0]) * (k % 3) / 2
    place = np.array([*reach * np.array([np.cos(angle), np.sin(angle)]), heights[k % 2]])
    place[:2] += focus[:2]
    yield place, (focus - place) / np.linalg.norm(focus - place)


def places(count: int, subject: str, rng: np.random.Generator) -> np.ndarray:
  """Poses [N, 4, 4] of the upright camera in the room."""
  views = _ring(count) if subject == "room" else _arc(count, subject)
  poses = np.tile(np.eye(4), (count, 1, 1))
  for pose, (place, forward) in zip(poses, views, strict=True):
    roll = rng.normal(0, _TURN)
    turn = [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
    pose[:3, :3] = camera_axes(forward) @ np.array(turn)
    pose[:3, 3] = place + rng.normal(0, _STEP_ASIDE, 3)
  return poses


def save(path: Path, picture: np.ndarray, *, upright: bool, millimetres: int) -> None:
  """Writes a picture [H, W, 3] as a phone does: as its sensor has it, with what EXIF says of it.

  Args:
    path: Where.
    picture: Its content.
    upright: Whether the phone was held so.
    millimetres: Focal length for film of 36 mm width.
  """
  exif = PIL.Image.Exif()
  exif[PIL.ExifTags.Base.Orientation] = 6 if upright else 1
  detail = exif.get_ifd(PIL.ExifTags.IFD.Exif)
  detail[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = millimetres
  PIL.Image.fromarray(picture).save(path, quality=_QUALITY, exif=exif)


def photograph(
  folder: Path, megapixels: float, *, count: int, subject: str, seed: int, mixed: bool = False
) -> np.ndarray:
  """Writes the photographs; returns the poses [N, 4, 4] of the phone's sensor."""
  folder.mkdir(parents=True, exist_ok=True)
  rng = np.random.default_rng([seed, 9])
  poses = places(count, subject, rng)
  width = round(np.sqrt(1e6 * megapixels * _ASPECT) / 16) * 16
  size = (width, round(width / _ASPECT))
  with room.room_eye(seed) as eye:
    for k, pose in enumerate(poses):
      upright, fate = k % 3 == 2, _FATES.get(k % 10, "") if mixed else ""
      if upright:
        pose[:3, :3] = pose[:3, :3] @ UPRIGHT_FROM_SENSOR
      longer = _SECOND_LENS if fate == "second lens" else 1.0
      lens = dataclasses.replace(_LENS, fx=longer * _LENS.fx, fy=longer * _LENS.fy)
      if mixed and k == _STRANGER:
        with room.room_eye(seed + 1) as other:
          picture = other.render(lens, pose, supersample=1)[0].astype(np.float32)
      else:
        picture = eye.render(lens, pose, supersample=1)[0].astype(np.float32)
      if fate == "blurred":
        picture = cv2.blur(picture, (_BLUR, 1))
      picture = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
      picture = np.exp(rng.normal(0, _EXPOSURE[mixed])) * picture
      picture += 2 * rng.standard_normal(picture.shape, np.float32)
      image = PIL.Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
      path = folder / f"IMG_{k:04d}.jpg"
      if fate in ("png", "reduced"):  # upright by its pixels, without EXIF
        image = image.transpose(PIL.Image.Transpose.ROTATE_270) if upright else image
        if fate == "reduced":
          image.thumbnail((_REDUCED, _REDUCED))
        image.save(path.with_suffix(".png" if fate == "png" else ".jpg"), quality=_QUALITY)
        continue
      save(path, np.asarray(image), upright=upright, millimetres=round(longer * _MILLIMETRES))
  if mixed:
    shutil.copy(folder / "IMG_0000.jpg", folder / "IMG_0000 (1).jpg")
  return poses


def _peak_memory() -> float:
  """Peak memory of this process [MB]; that of getrusage counts the parent's from before exec."""
  status = Path("/proc/self/status").read_text()
  line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
  return int(line.split()[1]) / 1024


def _read(files: list[Path], least: int | None) -> tuple[float, float]:
  """Seconds of processor time a picture, and peak memory [MB] of this process."""
  began = time.process_time()
  for path in files:
    stills.read_still(path, least=least)
  spent = (time.process_time() - began) / len(files)
  return spent, _peak_memory()


def _keyframes(source: Path, folder: Path) -> tuple[float, float]:
  """Seconds of processor time a picture for keyframes, and peak memory [MB] of this process."""
  began = time.process_time()
  found = read_capture(source, folder)
  spent = (time.process_time() - began) / len(found.images)
  return spent, _peak_memory()


def _features(folder: Path, database: Path) -> tuple[float, float]:
  """Seconds of processor time a picture for features, and peak memory [MB] of this process."""
  names = [path.name for path in stills.list_images(folder)][:_READ]
  began = time.process_time()
  settings = features.FeatureSettings()
  features.extract_features(database, folder, names, settings=settings)
  spent = (time.process_time() - began) / len(names)
  return spent, _peak_memory()


def costs(folder: Path, work: Path) -> dict[str, harness.Value]:
  """Times a picture and peak memory of what happens to photographs before anything else."""
  files = sorted(folder.glob("*.jpg"))
  work.mkdir(parents=True, exist_ok=True)
  database = work / "database.db"
  database.unlink(missing_ok=True)
  least = CaptureSettings().max_size
  steps = (
    ("reading_in_full", _read, (files[:_READ], None)),
    ("reading", _read, (files[:_READ], least)),
    ("keyframes", _keyframes, (folder, work / "keyframes")),
    ("features", _features, (work / "keyframes", database)),
  )
  found: dict[str, harness.Value] = {"file_mb": files[0].stat().st_size / 1e6}
  for name, step, arguments in steps:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
      spent, memory = pool.apply(step, arguments)
    found |= {f"{name}_s": spent, f"{name}_peak_mb": memory}
  return found


def _number(path: Path) -> int:
  """A photograph's number, of its name."""
  return int(path.stem.split("_")[1][:4])


def make_scene(folder: Path, poses: np.ndarray, settings: Settings) -> dict[str, harness.Value]:
  """Makes a scene of the photographs and measures it against the truth."""

  # Keyframes count the files that are of one camera.
  numbers = [_number(path) for path in stills.of_one_camera(stills.list_images(folder)).files]

  def measure(result: Reconstruction) -> TruthFigures:
    rows = [numbers[int(Path(name).stem.split("_")[-1])] for name in result.localisation.names]
    if settings.mixed and _STRANGER in rows:
      print("the picture of another room was placed")
    return ground_truth.compare(result, poses[rows])

  used = dataclasses.replace(preset(settings.preset), marker_side=ground_truth.MARKER_SIDE)
  used = with_marker(used, ground_truth.MARKER_AT)
  used = with_steps(used, settings.train_steps)
  began = time.perf_counter()
  made = pipeline.make_scene(folder, settings.work / "scene", settings=used, measure=measure)
  seconds = time.perf_counter() - began
  names = ["registered_fraction", "held_out_psnr_db", "robot_psnr_db", "camera_rmse_m"]
  names += ["collision_true_within_5cm", "surface_true_within_5cm", "free_area_m2", "scale_error"]
  names += ["sight_lines_blocked"]
  figures: dict[str, harness.Value] = {name: float(made.figures[name]) for name in names}
  for warning in made.scene["warnings"]:
    print("warning:", warning)
  return {**figures, "wall_time_s": seconds}


def main(settings: Settings) -> None:
  """Photographs, measures and prints."""
  figures: dict[str, dict[str, harness.Value]] = {}
  first: tuple[Path, np.ndarray] | None = None
  for megapixels in settings.megapixels:
    folder = settings.work / f"photographs_{megapixels:g}"
    count = _READ if first else settings.count
    poses = photograph(
      folder,
      megapixels,
      count=count,
      subject=settings.subject,
      seed=settings.seed,
      mixed=settings.mixed,
    )
    figures[f"photographs_of_{megapixels:g}_megapixels"] = costs(folder, settings.work / "costs")
    first = first or (folder, poses)
  if settings.scene and first is not None:
    figures["scene_of_photographs"] = make_scene(*first, settings)
  harness.finish("stills", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
