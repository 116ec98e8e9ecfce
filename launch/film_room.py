"""Films a walk through the built-in room and writes its truth beside the video.

python launch/film_room.py --out out/room.mp4
"""

import dataclasses
import sys
from pathlib import Path

import tyro

from nerf2real.launch import command
from nerf2real.scenes.builtin import filming


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Films a walk through the built-in room and writes its truth beside the video."""

  out: Path
  """The video (.mp4); its truth goes to NAME_truth.json beside it."""
  seed: int = 0
  """Seed of the room, the path and the noise."""
  film: tyro.conf.OmitArgPrefixes[filming.FilmSettings] = dataclasses.field(
    default_factory=filming.FilmSettings
  )
  """How it is filmed."""
  robot_views: Path | None = None
  """Also writes what the robot's camera truly sees at the policies' picture sizes (.npz)."""


def run(arguments: Arguments) -> None:
  """Films, with a bar of progress."""
  import rich.console

  from nerf2real.core.progress import progress_bar
  from nerf2real.scenes.builtin import ground_truth
  from nerf2real.scenes.builtin.mujoco_renderer import EglMissingError

  if arguments.out.suffix != ".mp4":
    raise ValueError(f"{arguments.out} is no name of a film: expected one that ends in .mp4.")
  console = rich.console.Console(stderr=True)
  try:
    with progress_bar("filming", console=console) as progress:
      filming.film(arguments.out, seed=arguments.seed, settings=arguments.film, progress=progress)
    if arguments.robot_views is not None:
      ground_truth.write_robot_views(arguments.robot_views, seed=arguments.seed)
  except EglMissingError as error:
    raise command.CommandError(error) from error
  console.print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.1f} MB")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run)


if __name__ == "__main__":
  sys.exit(main())
