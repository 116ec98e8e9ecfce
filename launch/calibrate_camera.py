"""Calibrates a camera from a video or pictures of a checkerboard; writes camera_info as ROS does.

python launch/calibrate_camera.py board.mp4 --corners 7 7 --out camera_info.yaml
"""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from nerf2real.launch import command

if TYPE_CHECKING:
  from nerf2real.real.camera.calibration import Calibration

_PIXELS = ("fx", "fy", "cx", "cy")
_MIN_COVERAGE = 0.4  # of the picture's cells; chosen: below it the distortion is a guess at the rim


@dataclasses.dataclass(frozen=True)
class Arguments:
  """Calibrates a camera from a video or pictures of a checkerboard."""

  source: Annotated[Path, tyro.conf.Positional]
  """A video, or a folder of pictures, of a flat checkerboard."""
  corners: tuple[int, int] = (7, 7)
  """Inner corners along a row and along a column: 8 x 8 squares have 7 x 7."""
  every: int = 2
  """Takes every n-th frame of a video."""
  name: str = "camera"
  """Name of the camera in the file."""
  out: Path | None = None
  """Where to write the camera_info YAML; nothing is written if not given."""


def run(arguments: Arguments) -> None:
  """Finds the boards, fits the lens, prints and writes it."""
  from rich.progress import track

  from nerf2real.real.camera import calibration

  every = 1 if arguments.source.is_dir() else arguments.every
  pictures = calibration.read_pictures(arguments.source, every=every)
  found = []
  for name, picture in track(pictures, "looking for the board", disable=not sys.stderr.isatty()):
    view = calibration.find_board(name, picture, corners=arguments.corners)
    if view is not None:
      found.append(view)
  result = calibration.calibrate(found, corners=arguments.corners)
  show(result)
  if arguments.out is not None:
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    calibration.write_camera_info(arguments.out, result, name=arguments.name)
    print(f"wrote {arguments.out}")


def show(result: "Calibration") -> None:
  """Prints the result as a table."""
  from rich.console import Console
  from rich.table import Table

  from nerf2real.core.geometry.cameras import LENS

  table = Table("", "value", "+-", "unit")
  for name, value, stddev in zip(LENS, result.values, result.stddevs, strict=True):
    unit = "pixel" if name in _PIXELS else ""
    digits = 2 if unit else 4
    table.add_row(name, f"{value:.{digits}f}", f"{stddev:.{digits}f}", unit)
  Console().print(table)
  print(
    f"{result.width} x {result.height}, {len(result.views)} views "
    f"({len(result.rejected)} rejected), RMS {result.rms:.3f} pixel, corners in "
    f"{result.coverage:.0%} of the picture"
  )
  if result.coverage < _MIN_COVERAGE:
    print(
      "warning: hold the board in the corners of the picture too; the distortion there is "
      "extrapolated"
    )


def main() -> int:
  """Runs the command line; returns the exit status."""
  return command.main(Arguments, run)


if __name__ == "__main__":
  sys.exit(main())
