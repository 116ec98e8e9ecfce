"""Scenes of other rooms than the built-in one: drawn, filmed, made, compared with the truth.

  python benchmarks/other_rooms.py --work out/rooms --seeds 1 2 3
  python benchmarks/other_rooms.py --work out/rooms --seeds 1 --no-scene    # the film alone
  python benchmarks/other_rooms.py --work out/rooms --seeds 1 --capture photographs

Each seed draws a room (`drawn_rooms/`), films it for a minute by hand with a lens of its own and
automatic exposure, and makes a scene of the film by a preset; or of 35 photographs; or of the
film's pictures with a depth sensor's measurements and a tracker's poses. A film that is there is
kept, and so is what a run before has made of it.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks import harness
from benchmarks.drawn_rooms import captures
from nerf2real.core.serialization import write_json
from nerf2real.scenes import pipeline
from nerf2real.scenes.alignment.marker_place import MarkerPlace
from nerf2real.scenes.builtin import furniture, ground_truth
from nerf2real.scenes.builtin.room import TrueRoom
from nerf2real.scenes.geometry.floor_plan import FreeSpaceSettings
from nerf2real.scenes.poses.localisation import LocalisationError
from nerf2real.scenes.quality import image_quality
from nerf2real.scenes.quality.held_out import ViewScore
from nerf2real.scenes.settings import preset, with_marker, with_steps
from nerf2real.scenes.stages.results import Reconstruction, TruthFigures

_CELL = 0.02  # m of the true map
_FIGURES = (
  *("registered_fraction", "camera_rmse_m", "scale_error", "floor_tilt_deg"),
  *("held_out_psnr_db", "robot_psnr_db", "robot_psnr_own_gain_db", "robot_psnr_60x80_db"),
  *("collision_true_within_5cm", "surface_true_within_5cm", "collision_true_p95_m"),
  *("sight_lines_blocked", "free_area_m2", "free_area_apart_m2"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which rooms, and how their scenes are made."""

  work: Path
  """Folder of films and bundles."""
  seeds: tuple[int, ...] = (1, 2, 3)
  """Of the rooms."""
  capture: captures.Kind = "film"
  """What the scenes are made of."""
  preset: str = "fast"
  """Preset of the scenes."""
  train_steps: int | None = None
  """Of the training; as many as the preset's time allows for None."""
  scene: bool = True
  """Make scenes and measure them."""


def true_free_area(true_room: TrueRoom) -> tuple[float, float]:
  """Returns the largest piece of floor that a robot can walk about on, and the others' [m^2]."""
  robot = FreeSpaceSettings()
  u, v = (np.arange(_CELL / 2, s, _CELL) - s / 2 for s in true_room.size[:2])
  free = np.ones((len(v), len(u)), bool)
  for height in np.arange(robot.low + 0.005, robot.high, 0.02):
    points = np.stack([*np.meshgrid(u, v), np.full((len(v), len(u)), height)], -1)
    free &= true_room.distance(points.reshape(-1, 3), limit=0.1).reshape(free.shape) > 0.0
  walled = np.pad(free.astype(np.uint8), 1)
  standing = cv2.distanceTransform(walled, cv2.DIST_L2, 5)[1:-1, 1:-1] * _CELL > robot.radius
  pieces = cv2.connectedComponents(standing.astype(np.uint8), connectivity=4)[1]
  areas = np.sort(np.bincount(pieces.ravel())[1:])[::-1] * _CELL**2
  return (float(areas[0]), float(areas[1:].sum())) if len(areas) else (0.0, 0.0)


def psnr_with_gain(views: Sequence[ViewScore]) -> float:
  """Returns the pictures' mean PSNR with one gain a channel for all [dB].

  How bright the robot's own camera is, no picture of a phone with automatic exposure tells.
  """
  true, seen = (np.stack([getattr(view, k) for view in views]) for k in ("truth", "image"))
  seen = seen.astype(np.float64)
  gain = (seen * true).sum((0, 1, 2)) / (seen**2).sum((0, 1, 2))
  fitted = np.rint(np.clip(gain * seen, 0, 255)).astype(np.uint8)
  return float(np.mean([image_quality.psnr(a, b) for a, b in zip(fitted, true, strict=True)]))


def make(folder: Path, seed: int, settings: Settings) -> dict[str, harness.Value]:
  """Draws, films and reconstructs one room; returns its figures."""
  drawn = captures.draw(seed)
  known = captures.film(folder, drawn.room, seed)
  if not settings.scene:
    return {"solids": len(drawn.room.solids)}
  source, poses = captures.captured(folder, drawn.room, seed, settings.capture)

  def measure(result: Reconstruction) -> TruthFigures:
    rows = [int(Path(name).stem.split("_")[-1]) for name in result.localisation.names]
    found = ground_truth.compare(result, poses[rows], true_room=drawn.room, pictures=known)
    gained = {"robot_psnr_own_gain_db": psnr_with_gain(found.robot_views)}
    return found._replace(figures={**found.figures, **gained})

  used = preset(settings.preset)
  if settings.capture != "depth":
    x, y, turn = drawn.marker
    used = dataclasses.replace(used, marker_side=furniture.MARKER_SIZE)
    used = with_marker(used, MarkerPlace(x, y, float(np.degrees(turn))))
  used = with_steps(used, settings.train_steps)
  scene = "scene" if settings.capture == "film" else f"scene_{settings.capture}"
  began = time.process_time()
  try:
    made = pipeline.make_scene(source, folder / scene, settings=used, measure=measure)
  except (LocalisationError, ValueError) as error:
    return {"refused": str(error)}
  for warning in made.scene["warnings"]:
    print("warning:", warning)
  one, apart = true_free_area(drawn.room)
  figures: dict[str, harness.Value] = {"true_free_area_m2": one, "true_free_area_apart_m2": apart}
  figures |= {name: float(made.figures[name]) for name in _FIGURES if name in made.figures}
  write_json(folder / scene / "figures.json", figures)
  return figures | {"processor_s": time.process_time() - began}


def main(settings: Settings) -> None:
  """Makes all rooms, one after the other, and prints."""
  figures = {}
  for seed in settings.seeds:
    name = f"room_{seed}" + ("" if settings.capture == "film" else f"_{settings.capture}")
    figures[name] = make(settings.work / str(seed), seed, settings)
    print(f"{name}: {figures[name]}", flush=True)
  harness.finish("other_rooms", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
