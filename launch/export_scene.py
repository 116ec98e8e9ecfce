"""Exports a scene bundle for other programs: splats, MJCF, USD, glTF, nerfstudio, height map.

python launch/export_scene.py out/room --to mjcf --out out/room_mjcf --robot op3
python launch/export_scene.py out/room --to splat --out room.ply
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nerf2real.launch import command


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Exports a scene bundle for other programs."""

  bundle: Annotated[Path | None, tyro.conf.Positional] = None
  """Folder of the scene bundle; the built-in room if not given."""
  to: Annotated[
    Literal["splat", "mjcf", "usd", "glb", "nerfstudio", "heightfield"], tyro.conf.arg()
  ] = tyro.MISSING
  """"splat": 3D Gaussians (.ply); "mjcf": a folder for MuJoCo; "usd" and "glb": one file;
  "nerfstudio": pictures and transforms.json; "heightfield": PNG and MJCF hfield."""
  out: Path = tyro.MISSING
  """File or folder to write; an earlier export of the kind is replaced."""
  robot: Literal["op3"] | None = None
  """Robot that stands in an MJCF scene."""
  splat_seconds: float | None = None
  """Time of the splats' fit at most [s]; its own number of steps if not given."""


def run(arguments: Arguments) -> None:
  """Writes the export and prints how to open it."""
  from nerf2real.core.progress import progress_bar
  from nerf2real.scenes.bundle import Bundle
  from nerf2real.scenes.export import exporting

  robot = None
  if arguments.robot is not None:
    from nerf2real.suite.standalone import standing_robot

    robot = standing_robot()
  with progress_bar(f"export {arguments.to}") as progress:
    order = exporting.Order(
      Bundle.load(arguments.bundle), arguments.out, robot, arguments.splat_seconds, progress
    )
    line = exporting.export(arguments.to, order)
  print(f"{arguments.out}: {line}")


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run, environment=command.NOT_DRAWING)


if __name__ == "__main__":
  sys.exit(main())
