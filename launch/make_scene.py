"""Makes a scene bundle from a video or pictures of a room.

  python launch/make_scene.py --capture room.mp4 --out out/room --marker-side 0.2
  python launch/make_scene.py --capture room.mp4 --out out/room --marker-side 0.2 --marker-at 0 0 0
  python launch/make_scene.py --capture builtin --out out/demo --preset demo
  python launch/make_scene.py --capture builtin --out out/demo --preset demo --viewer
  python launch/make_scene.py --capture room.mp4 --out out/room --check

A second run with the same --out continues where the first one stopped.
"""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerf2real.launch import command

if TYPE_CHECKING:
  from nerf2real.scenes.bundle import Bundle
  from nerf2real.scenes.settings import SceneSettings
  from nerf2real.scenes.stages.results import Watcher

BUILT_IN = "builtin"  # the capture that is the project's own room
FILM_AGAIN = 3  # exit status of --check


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arguments:
  """Makes a scene bundle from a video or pictures of a room."""

  capture: str
  """A video, a folder of pictures, a COLMAP model, a transforms.json, an RGB-D sequence with poses
  (TUM's, 7-Scenes' or ScanNet's layout), or "builtin" for the project's own room."""
  out: Path
  """Folder of the bundle."""
  preset: Literal["fast", "quality", "demo", "tiny", "paper"] = "fast"
  """"fast": two CPU cores; "quality": the same with an hour of training; "demo": quicker; "tiny": a
  first look, 60 pictures and a minute of training; "paper": the paper's tables, for a GPU."""
  keyframes: int | None = None
  """Pictures to take from the capture; the preset's number if not given."""
  train_seconds: float | None = None
  """Seconds of training; the preset's if not given."""
  train_steps: int | None = None
  """Steps of training in place of seconds: a busy machine takes longer for the same field."""
  device: Literal["cpu", "cuda"] = "cpu"
  """Where the field is trained; preset "paper" trains where JAX does."""
  marker_side: float | None = None
  """Side of the black square of an ArUco or AprilTag marker in the room [m]: gives the scale."""
  marker_at: tuple[float, float, float] | None = None
  """Where the marker is to be on the map: x, y of its centre [m] and the heading [degrees] of its
  upper edge from the x axis. The map's origin and axes are then the same in every film of the room,
  and places on it can be measured from the marker; else the origin is the middle of the room."""
  camera_height: float | None = None
  """Median height of the camera above the floor [m]: gives the scale where there is no marker."""
  override: Path | None = None
  """YAML or JSON that fixes floor, scale, yaw, extent; see scenes/alignment/overrides.py."""
  baseline: Literal["none", "colmap"] | None = None
  """"colmap" adds the Poisson mesh of the COLMAP points to the report."""
  name: str | None = None
  """The scene's name; the output folder's if not given."""
  check: bool = False
  """Stops after keyframes and poses with a verdict: what to film again, and where (check.png in
  --out). Exit status 3 where something should be filmed again. The scene continues from there."""
  viewer: bool = False
  """Shows poses and field in a browser while they are made, with PSNR and time left."""
  host: str = "127.0.0.1"
  """Address of that page."""
  port: int = 8080
  """Port of that page."""


def settings_of(arguments: Arguments) -> "SceneSettings":
  """Applies the arguments to their preset."""
  from nerf2real.scenes.alignment.marker_place import MarkerPlace
  from nerf2real.scenes.builtin import ground_truth
  from nerf2real.scenes.settings import preset, with_marker

  settings = preset(arguments.preset)
  if arguments.keyframes is not None:
    taken = dataclasses.replace(
      settings.capture, num_keyframes=arguments.keyframes, most_keyframes=None
    )
    settings = dataclasses.replace(settings, capture=taken)
  training = dataclasses.replace(settings.train, device=arguments.device)
  if arguments.train_seconds is not None:
    training = dataclasses.replace(training, max_seconds=arguments.train_seconds)
  if arguments.train_steps is not None:
    training = dataclasses.replace(
      training, max_steps=arguments.train_steps, max_seconds=arguments.train_seconds
    )
  settings = dataclasses.replace(settings, train=training)
  if arguments.camera_height is not None:
    placing = dataclasses.replace(settings.align, camera_height=arguments.camera_height)
    settings = dataclasses.replace(settings, align=placing)
  side = arguments.marker_side
  place = None if arguments.marker_at is None else MarkerPlace(*arguments.marker_at)
  if arguments.capture == BUILT_IN:
    side = ground_truth.MARKER_SIDE if side is None else side
    place = place or ground_truth.MARKER_AT
  if side is not None:
    settings = dataclasses.replace(settings, marker_side=side)
  if place is not None:
    settings = with_marker(settings, place)
  if arguments.baseline is not None:
    settings = dataclasses.replace(settings, baseline=arguments.baseline)
  return settings


def _print_figures(scene: "Bundle") -> None:
  import rich
  from rich.markup import escape
  from rich.table import Table

  table = Table("figure", "value", title=f"scene {escape(scene.name)}")
  for key, value in scene.figures.items():
    if isinstance(value, (int, float)):
      table.add_row(key, f"{value:.4g}")
    elif isinstance(value, str):
      table.add_row(key, escape(value))
  table.add_row("seconds", f"{sum(scene.scene['seconds'].values()):.0f}")
  rich.print(table)
  for warning in scene.scene["warnings"]:
    rich.print(f"[yellow]warning:[/] {escape(warning)}")


def _check(arguments: Arguments, source: Path, settings: "SceneSettings") -> int:
  """Prints the verdict on the capture; returns the exit status."""
  from nerf2real.scenes.checking import check_capture

  verdict = check_capture(source, arguments.out, settings=settings, override=arguments.override)
  print(verdict.words)
  if verdict.picture is not None:
    verdict.save_picture(arguments.out / "check.png")
    print(f"where: {arguments.out / 'check.png'}, the room from above")
  return 0 if verdict.good else FILM_AGAIN


@contextlib.contextmanager
def _watched(arguments: Arguments) -> Iterator["Watcher | None"]:
  """Gives the page of --viewer while the scene is made; None without it."""
  if not arguments.viewer:
    yield None
    return
  from nerf2real.scenes.viewing.training_viewer import TrainingViewer

  viewer = TrainingViewer(host=arguments.host, port=arguments.port)
  command.tell_port(arguments.port, viewer.port)
  print(f"watch it grow: {viewer.address}")
  try:
    yield viewer
  finally:
    viewer.close()


def run(arguments: Arguments) -> int:
  """Makes the scene and prints its figures; returns the exit status."""
  from nerf2real.scenes import pipeline
  from nerf2real.scenes.builtin import ground_truth
  from nerf2real.scenes.field.engine.device import Device

  settings = settings_of(arguments)
  Device(arguments.device)  # a machine without it says so before the hour, not after
  source, measure = Path(arguments.capture), None
  if arguments.capture == BUILT_IN:
    source, measure = ground_truth.VIDEO, ground_truth.measure
  if arguments.check:
    return _check(arguments, source, settings)
  with _watched(arguments) as watcher:
    scene = pipeline.make_scene(
      source,
      arguments.out,
      settings=settings,
      override=arguments.override,
      name=arguments.name,
      measure=measure,
      watcher=watcher,
    )
  _print_figures(scene)
  print(f"report: {arguments.out / 'report.html'}")
  return 0


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(
    Arguments,
    run,
    errors=(ValueError, OSError, FloatingPointError),
    interrupted="interrupted: run the same command again, it continues where it stopped",
  )


if __name__ == "__main__":
  sys.exit(main())
