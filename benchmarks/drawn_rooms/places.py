"""Localises captures of drawn rooms and compares every place with the true one.

  python benchmarks/drawn_rooms/places.py --work out/rooms --seeds 1 2 3 --capture photographs

What matters most in a figure of all places, their root mean square, is whether one of them is
altogether wrong: those are counted. No field is trained.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np

from benchmarks import harness
from benchmarks.drawn_rooms import captures
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.settings import preset
from nerf2real.scenes.source import open_source
from nerf2real.scenes.stages import localising
from nerf2real.scenes.stages.cache import Stages

_WRONG = 0.1  # m from the truth


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which rooms, and how they are captured."""

  work: Path
  """Folder of captures, features and models."""
  seeds: tuple[int, ...] = (1, 2, 3)
  """Of the rooms."""
  capture: captures.Kind = "photographs"
  """What the places are found in."""


def position_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
  """Distances [N] [m] of positions [N, 3] in any frame from the true ones [N, 3], by the similarity
  that most agree on."""
  return np.linalg.norm(Similarity.fit_most(found, true).apply(found) - true, axis=1)


def localise(folder: Path, seed: int, kind: captures.Kind) -> dict[str, harness.Value]:
  """Captures and localises one room; returns its figures."""
  source, true = captures.captured(folder, captures.draw(seed).room, seed, kind)
  settings = preset("fast")
  cache = Stages(folder / f"{kind}_places", show_progress=False)
  capture = localising.keyframes(cache, open_source(source, cache.folder), settings.capture)
  began = time.monotonic()
  try:
    poses = localising.poses(cache, capture, settings.localise)
  except LocalisationError as error:
    return {"refused": str(error)}
  _, poses = localising.aligned(cache, localising.sensed(cache, capture, poses), poses)
  result = poses.value
  rows = [int(Path(name).stem.split("_")[-1]) for name in result.names]
  errors = position_errors(result.world_from_camera[:, :3, 3], true[rows][:, :3, 3])
  for row in np.flatnonzero(errors > _WRONG):
    print(f"wrong: {result.names[row]} {errors[row]:.2f} m")
  return {
    "placed": result.registered_fraction,
    "wrong": int((errors > _WRONG).sum()),
    "rmse_m": float(np.sqrt(np.mean(errors**2))),
    "median_m": float(np.median(errors)),
    "strategy": result.strategy,
    "warnings": " ".join(result.warnings),
    "wall_s": time.monotonic() - began,
  }


def main(settings: Settings) -> None:
  """Localises all rooms, one after the other, and prints."""
  figures = {}
  for seed in settings.seeds:
    name = f"room_{seed}_{settings.capture}"
    figures[name] = localise(settings.work / str(seed), seed, settings.capture)
    print(f"{name}: {figures[name]}", flush=True)
  harness.finish("places", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
