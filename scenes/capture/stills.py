"""Stills of one camera among the pictures of a folder: one size, one orientation, one zoom.

A phone's photographs may be upright and wide, of its main and of its wide lens; structure from
motion here has one camera. What most of them have in common is kept.
"""

import collections
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import PIL.ExifTags
import PIL.Image

from nerf2real.scenes.capture.video import CaptureError

APPLE_SUFFIXES = (".heic", ".heif")  # what iPhones write; OpenCV does not read them
_TURNED = (5, 6, 7, 8)  # EXIF orientations with width and height exchanged


class Look(NamedTuple):
  """What stills of one camera have in common."""

  width: int  # as shown, upright
  height: int
  focal: float | None  # equivalent for film of 36 mm width [mm]; None where the file says nothing

  def __str__(self) -> str:
    lens = "" if self.focal is None else f" with a lens of {self.focal:g} mm"
    return f"{self.width}x{self.height}{lens}"


def look_of(path: Path) -> Look:
  """Reads a still's size and lens from its header.

  Raises:
    CaptureError: It is no picture.
  """
  try:
    with PIL.Image.open(path) as image:
      width, height = image.size
      exif = image.getexif()
      detail = exif.get_ifd(PIL.ExifTags.IFD.Exif)
  except (OSError, ValueError, SyntaxError) as error:
    raise CaptureError(
      f"{path} cannot be read as a picture: remove it or copy it again."
    ) from error
  if exif.get(PIL.ExifTags.Base.Orientation) in _TURNED:
    width, height = height, width
  focal = detail.get(PIL.ExifTags.Base.FocalLengthIn35mmFilm)
  return Look(width, height, float(focal) if focal else None)


def of_one_camera(files: Sequence[Path]) -> tuple[list[Path], list[str]]:
  """Keeps the pictures that share the most common size, orientation and zoom.

  Returns:
    The pictures, in their order, and a warning where some are left out.

  Raises:
    CaptureError: One is no picture.
  """
  looks = [look_of(path) for path in files]
  (common, number), *others = collections.Counter(looks).most_common()
  kept = [path for path, look in zip(files, looks, strict=True) if look == common]
  if not others:
    return kept, []
  rest = ", ".join(f"{count} of {look}" for look, count in others[:3])
  return kept, [
    f"Only {number} of {len(files)} pictures are {common}; left out are {rest}: expected one "
    "camera, one zoom and one orientation."
  ]


def apple_pictures(folder: Path) -> list[Path]:
  """Pictures of a folder in a format that only Apple's programs write."""
  return sorted(path for path in folder.iterdir() if path.suffix.lower() in APPLE_SUFFIXES)
