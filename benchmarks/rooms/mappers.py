"""Localises many keyframes of the built-in room's film by each mapper; compares with its poses.

  python benchmarks/rooms/mappers.py --work out/mappers --count 1000

Features and matches are found once, in the first run, and are the same for all mappers unless one
leaves so many keyframes out that more pairs are matched for it. A run that is cut short goes on
from them.
"""

import dataclasses
import time
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks import harness
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.progress import Progress
from nerf2real.scenes.builtin import filming, ground_truth
from nerf2real.scenes.capture import keyframes
from nerf2real.scenes.capture.capture import Capture, CaptureSettings
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses import structure_from_motion
from nerf2real.scenes.poses.localisation import Localisation
from nerf2real.scenes.poses.settings import LocaliseSettings

_SAID_EVERY = 30.0  # s between two lines of progress


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """How many keyframes, and by what."""

  work: Path
  """Folder of keyframes, features and models."""
  count: int = 1000
  """Keyframes; the film has 1,050 pictures."""
  mappers: tuple[Literal["global", "incremental"], ...] = ("global", "incremental")
  """Which are run, one after the other."""
  seed: int = 0
  """Of RANSAC and of the mappers."""


def take_keyframes(folder: Path, count: int) -> Capture:
  """Returns the sharpest frames of the film's parts; they are kept in the folder."""
  images = folder / "images"
  if not (folder / "capture.json").exists():
    chosen = CaptureSettings(num_keyframes=count)
    keyframes.save(read_capture(ground_truth.VIDEO, images, settings=chosen), folder)
  return keyframes.load(folder, images)


def position_errors(found: Localisation, capture: Capture) -> tuple[float, float]:
  """RMSE of the localised positions [m] and median of the angles [rad] against the film's truth."""
  truth = filming.read_truth(ground_truth.TRUTH)
  assert capture.times is not None  # of a film
  times = dict(zip([path.name for path in capture.images], capture.times, strict=True))
  frames = np.round(np.array([times[name] for name in found.names]) * truth["frame_rate"])
  true = truth["world_from_camera"][frames.astype(int)]
  place = found.world_from_camera[:, :3, 3]
  moved = Similarity.fit(place, true[:, :3, 3])
  off = np.linalg.norm(moved.apply(place) - true[:, :3, 3], axis=-1)
  turned = moved.rotation @ found.world_from_camera[:, :3, :3]
  cosine = (np.einsum("nij,nij->n", turned, true[:, :3, :3]) - 1) / 2  # of the turn, by its trace
  return float(np.sqrt(np.mean(off**2))), float(np.median(np.arccos(np.clip(cosine, -1, 1))))


def _telling(name: str) -> Progress:
  said = -_SAID_EVERY

  def tell(fraction: float, text: str) -> None:
    nonlocal said
    if time.monotonic() > said + _SAID_EVERY:
      said = time.monotonic()
      print(f"{name}: {100 * fraction:.0f} %: {text}", flush=True)

  return tell


def main(settings: Settings) -> None:
  """Localises by each mapper and prints the table."""
  capture = take_keyframes(settings.work, settings.count)
  figures: dict[str, dict[str, harness.Value]] = {}
  for name in settings.mappers:
    began, worked = time.perf_counter(), time.process_time()
    found = structure_from_motion.localise(
      capture.folder,
      settings.work,
      settings=LocaliseSettings(mapper=name, seed=settings.seed),
      times=dict(zip([p.name for p in capture.images], np.asarray(capture.times), strict=True)),
      progress=_telling(name),
    )
    distance, angle = position_errors(found, capture)
    figures[name] = {
      "registered": harness.Rate(len(found.names), len(capture.images)),
      "reprojection_px": found.reprojection_error_px,
      "positions_mm": 1e3 * distance,
      "angles_degrees": float(np.degrees(angle)),
      "points": len(found.points),
      **{f"{step}_s": seconds for step, seconds in found.seconds.items()},
      "whole_s": time.perf_counter() - began,
      "processor_s": time.process_time() - worked,
    }
    print(f"{name}: {found.strategy}", flush=True)
  harness.finish("mappers", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
