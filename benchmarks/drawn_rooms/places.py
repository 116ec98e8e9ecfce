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
from nerf2real.core.similarity import Similarity
from nerf2real.scenes.capture.reading import read_capture
from nerf2real.scenes.poses import structure_from_motion
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.settings import preset

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
  taken = read_capture(source, folder / f"{kind}_images", settings=settings.capture)
  names = [path.name for path in taken.images]
  times = taken.times if taken.times is None else dict(zip(names, taken.times, strict=True))
  began = time.monotonic()
  try:
    result = structure_from_motion.localise(
      taken.folder,
      folder / f"{kind}_places",
      settings=settings.localise,
      known=taken.known,
      times=times,
    )
  except LocalisationError as error:
    return {"refused": str(error)}
  rows = [int(Path(name).stem.split("_")[-1]) for name in result.names]
  errors = position_errors(result.world_from_camera[:, :3, 3], true[rows][:, :3, 3])
  for row in np.flatnonzero(errors > _WRONG):
    print(f"wrong: {result.names[row]} {errors[row]:.2f} m")
  return {
    "placed": len(errors) / len(names),
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
