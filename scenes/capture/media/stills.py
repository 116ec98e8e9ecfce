"""Stills of one camera among the pictures of a folder: one lens, one zoom, one shape.

A phone's photographs may be upright and wide, of several sizes, of its main and of its wide lens;
structure from motion here has one camera. A still that lies across the others is turned by a
quarter, so that its sensor lies as theirs; of several lenses the most common one is kept.
"""

import collections
import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pi_heif
import PIL.ExifTags
import PIL.Image
import PIL.ImageOps

from nerf2real.core.errors import first_few
from nerf2real.core.files import hash_path
from nerf2real.core.picture_files import decoded
from nerf2real.scenes.capture.media import colors
from nerf2real.scenes.capture.media.errors import CaptureError

APPLE_SUFFIXES = (".heic", ".heif")  # what iPhones write; OpenCV does not read them
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", *APPLE_SUFFIXES)
# A file's name may lie: what it holds says how it is read.
_JPEG = ("JPEG", "MPO")  # decoded at a reduced size; OpenCV resamples other formats
_BY_PIL = ("HEIF", "TIFF")  # libheif always turns the one, OpenCV fails with the other turned
_REDUCED = (
  (8, cv2.IMREAD_REDUCED_COLOR_8),
  (4, cv2.IMREAD_REDUCED_COLOR_4),
  (2, cv2.IMREAD_REDUCED_COLOR_2),
)
_ENOUGH = 1600  # long side at which features are sought: smaller pictures lose some [pixel]
_NAMED = 4  # files in a warning
_WIDE = ("I", "F")  # PIL's modes of one channel of 32 bits
_TURNED = (5, 6, 7, 8)  # EXIF orientations with width and height exchanged
_AS_STORED = {  # undoes each EXIF orientation
  2: PIL.Image.Transpose.FLIP_LEFT_RIGHT,
  3: PIL.Image.Transpose.ROTATE_180,
  4: PIL.Image.Transpose.FLIP_TOP_BOTTOM,
  5: PIL.Image.Transpose.TRANSPOSE,
  6: PIL.Image.Transpose.ROTATE_90,
  7: PIL.Image.Transpose.TRANSVERSE,
  8: PIL.Image.Transpose.ROTATE_270,
}
_Tag = PIL.ExifTags.Base
# Camera axes of the upright picture in those of the one that was turned counter-clockwise.
_TURNED_FROM_UPRIGHT = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

pi_heif.register_heif_opener()


def list_images(folder: Path) -> list[Path]:
  """Lists the pictures of a folder (not of its subfolders), sorted by name, without hidden files.

  macOS writes a file "._IMG_1.JPG", which is no picture, beside a picture on a foreign disk.
  """
  return sorted(
    path
    for path in folder.iterdir()
    if path.suffix.lower() in IMAGE_SUFFIXES and path.name[0] != "." and path.is_file()
  )


def list_images_below(source: Path) -> list[Path]:
  """Lists the pictures in source/images, the usual place beside a model."""
  return list_images(source / "images") if (source / "images").is_dir() else []


class Look(NamedTuple):
  """What tells a still's camera."""

  width: int  # as shown, upright
  height: int
  focal: float | None  # equivalent for film of 36 mm width [mm]; None where the file says nothing

  def __str__(self) -> str:
    lens = "" if self.focal is None else f" with a lens of {self.focal:g} mm"
    return f"{self.width}x{self.height}{lens}"

  @property
  def long_side(self) -> int:
    """Of the picture [pixel]."""
    return max(self.width, self.height)

  def short_side(self, long_side: int) -> int:
    """Of the picture when its long side is this [pixel]."""
    return round(min(self.width, self.height) * long_side / self.long_side)

  def shares_camera(self, other: "Look") -> bool:
    """Whether both may be of one camera, turned or reduced; a missing lens may be any."""
    lenses = {self.focal, other.focal} - {None}
    size = min(self.long_side, other.long_side)  # binning and scaling round a picture's size
    return abs(self.short_side(size) - other.short_side(size)) <= 1 and len(lenses) < 2


class Stills(NamedTuple):
  """The stills of one camera."""

  files: list[Path]
  turned: np.ndarray  # bool [N]: is to be turned by a quarter to lie as the others
  look: Look  # of most of them
  long_side: int  # of the smallest; the others are reduced to it [pixel]
  warnings: list[str]

  def size(self, limit: int) -> tuple[int, int]:
    """Width and height that all get, with a long side of at most a limit [pixel]."""
    long_side = min(limit, self.long_side)
    short_side = self.look.short_side(long_side)
    wide = self.look.width >= self.look.height
    return (long_side, short_side) if wide else (short_side, long_side)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[PIL.Image.Image]:
  """Opens a picture of any size; PIL refuses those of more than 178 megapixels by default."""
  limit = PIL.Image.MAX_IMAGE_PIXELS
  PIL.Image.MAX_IMAGE_PIXELS = None
  try:
    with PIL.Image.open(path) as image:
      yield image
  finally:
    PIL.Image.MAX_IMAGE_PIXELS = limit


def look_of(path: Path) -> Look:
  """Reads a still's size and lens from its header.

  Raises:
    CaptureError: It is no picture.
  """
  try:
    with opened(path) as image:
      exif = image.getexif()
      width, height = image.size
      if image.format == "TIFF":  # PIL turns its size, in some versions before it is loaded
        width, height = (exif[t] for t in (_Tag.ImageWidth, _Tag.ImageLength))
      detail = exif.get_ifd(PIL.ExifTags.IFD.Exif)
  except (OSError, ValueError, SyntaxError) as error:
    raise CaptureError(
      f"{path} cannot be read as a picture: remove it or copy it again ({error})."
    ) from error
  if exif.get(_Tag.Orientation) in _TURNED:
    width, height = height, width
  focal = 0.0
  with contextlib.suppress(TypeError, ValueError):  # EXIF may hold several numbers, or text
    focal = float(detail.get(_Tag.FocalLengthIn35mmFilm, 0))
  return Look(width, height, focal if focal > 0 else None)


def unreadable(lost: Sequence[Path], count: int) -> list[str]:
  """Says which of `count` files cannot be read, if any."""
  if not lost:
    return []
  names = first_few([printable(path) for path in lost], _NAMED)
  return [f"{len(lost)} of {count} files cannot be read as a picture, left out: {names}."]


def printable(path: Path) -> str:
  """A file's name with marks for what is no UTF-8, as of an old archive."""
  return os.fsencode(path.name).decode(errors="replace")


def _depth_maps(files: Sequence[Path]) -> list[Path]:
  """Files of one channel of 16 bits or more, if others are not so: a depth camera's."""
  found = []
  for path in files:
    with opened(path) as image:
      if image.mode in _WIDE or image.mode.startswith("I;16"):
        found.append(path)
  return found if len(found) < len(files) else []


def _without_copies(files: Sequence[Path]) -> list[Path]:
  """The files whose content did not come before, and none that was converted from another."""
  others = {path.stem for path in files if path.suffix.lower() not in APPLE_SUFFIXES}
  first: dict[str, Path] = {}
  for path in files:
    if path.suffix.lower() not in APPLE_SUFFIXES or path.stem not in others:
      first.setdefault(hash_path(path), path)
  return list(first.values())


def _most_common(looks: Sequence[Look]) -> Look:
  """The most common look of the camera that most pictures may be of."""
  told = [look for look in looks if look.focal is not None]
  # Of a shape that some files tell the lens of, the others may be of any lens.
  lenses = [k for k in looks if k.focal or not any(k.shares_camera(other) for other in told)]
  counts = {lens: sum(map(lens.shares_camera, looks)) for lens in dict.fromkeys(lenses)}
  lens = max(counts, key=lambda look: counts[look])
  sizes = collections.Counter(k[:2] for k in looks if lens.shares_camera(k))
  return Look(*sizes.most_common(1)[0][0], lens.focal)


def of_one_camera(files: Sequence[Path]) -> Stills:
  """Keeps the pictures of the most common camera, each once.

  Pictures in several sizes, as messengers make them, are all kept while the smallest shows as many
  features as the others. What is no picture, and depth maps beside pictures, are left out.

  Raises:
    CaptureError: None is a picture.
  """
  look_at, lost = {}, []
  for path in files:
    try:
      look_at[path] = look_of(path)
    except CaptureError:
      lost.append(path)
  warnings = unreadable(lost, len(files))
  if not look_at:
    raise CaptureError(f"{files[0].parent}: {' '.join(warnings)} Copy the pictures again.")
  if depth := _depth_maps(list(look_at)):
    warnings.append(
      f"{len(depth)} of {len(files)} pictures are depth maps (16-bit grey beside others), as "
      f"{printable(depth[0])}: left out, as they say nothing without poses."
    )
    look_at = {path: look for path, look in look_at.items() if path not in set(depth)}
  once = _without_copies(list(look_at))
  looks = [look_at[path] for path in once]
  common = _most_common(looks)
  least = min(common.long_side, _ENOUGH)
  alike = [look.shares_camera(common) and look.long_side >= least for look in looks]
  wide = common.width >= common.height
  kept = [path for path, same in zip(once, alike, strict=True) if same]
  across = [
    (look.width >= look.height) != wide for look, same in zip(looks, alike, strict=True) if same
  ]
  if copies := len(look_at) - len(once):
    warnings.append(f"{copies} of {len(files)} pictures are copies of others.")
  others = collections.Counter(look for look, same in zip(looks, alike, strict=True) if not same)
  if others:
    rest = ", ".join(f"{count} of {look}" for look, count in others.most_common(3))
    warnings.append(
      f"Only {len(kept)} of {len(once)} pictures are of one camera, {common}, and {least} pixels "
      f"or longer; left out are {rest}: expected one camera and one zoom."
    )
  smallest = min(look.long_side for look, same in zip(looks, alike, strict=True) if same)
  return Stills(kept, np.array(across), common, smallest, warnings)


def read_still(path: Path, *, least: int | None = None, upright: bool = True) -> np.ndarray:
  """Reads a picture upright (EXIF) as BGR uint8 [H, W, 3] of sRGB; transparent parts keep their
  colour.

  A JPEG that is at least twice as large as needed is decoded at a half, a quarter or an eighth of
  its size, each pixel the mean over its area (libjpeg's scaled inverse transform).

  Args:
    path: The picture.
    least: Long side that is needed [pixel]; the picture's own if None.
    upright: Whether EXIF turns it; one of Apple's formats always is.

  Raises:
    CaptureError: It is damaged, cut off, or no picture.
  """
  image, profile, form, how = None, None, None, cv2.IMREAD_COLOR
  with contextlib.suppress(OSError, ValueError, SyntaxError), opened(path) as picture:
    form, profile = picture.format, picture.info.get("icc_profile")
    if form in _BY_PIL:
      image = _converted(picture, upright=upright)
    elif form in _JPEG and least is not None:
      how = _reduction(max(picture.size), least)
  if form not in _BY_PIL and path.is_file():
    data = path.read_bytes()
    if form not in _JPEG or not _is_cut_off(data):
      image = decoded(data, how | (0 if upright else cv2.IMREAD_IGNORE_ORIENTATION))
  if image is None:
    raise CaptureError(f"{path} cannot be read as a picture: remove it or copy it again.")
  return colors.to_srgb(image, profile)


def _converted(picture: PIL.Image.Image, *, upright: bool) -> np.ndarray | None:
  """Pixels BGR uint8 [H, W, 3] of an opened picture that PIL turns; None of one of floats."""
  orientation = picture.getexif().get(_Tag.Orientation)
  picture = PIL.ImageOps.exif_transpose(picture)
  if not upright and orientation in _AS_STORED:
    picture = picture.transpose(_AS_STORED[orientation])
  if picture.mode.startswith("I;16"):  # which PIL clips at 255
    return cv2.cvtColor((np.asarray(picture) >> 8).astype(np.uint8), cv2.COLOR_GRAY2BGR)
  if picture.mode in _WIDE:
    return None
  return np.ascontiguousarray(np.asarray(picture.convert("RGB"))[..., ::-1])


def _is_cut_off(data: bytes) -> bool:
  """Whether a JPEG lacks its end, in place of which libjpeg would give grey.

  Its end is marked; so may be that of a thumbnail, in a segment before the picture's own scan.
  Source: ITU-T T.81, annex B.
  """
  at = 2
  while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
    filled = data[at + 1 : at + 2] == b"\xff"
    at += 1 if filled else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
  return data.find(b"\xff\xd9", at) < 0


def _reduction(long_side: int, least: int) -> int:
  """OpenCV's flag to read a picture with: reduced as far as the long side that is needed allows."""
  fitting = (flag for divisor, flag in _REDUCED if long_side >= divisor * least)
  return next(fitting, cv2.IMREAD_COLOR)


def quarter_turned(image: np.ndarray) -> np.ndarray:
  """Turns a picture [H, W, 3] counter-clockwise by a quarter: what was up is left."""
  return np.ascontiguousarray(np.rot90(image))


def upright_poses(world_from_camera: np.ndarray, turned: np.ndarray) -> np.ndarray:
  """Poses [N, 4, 4] of the pictures as they were before some were turned (bool [N])."""
  poses = np.array(world_from_camera, np.float64)
  poses[turned, :3, :3] = poses[turned, :3, :3] @ _TURNED_FROM_UPRIGHT
  return poses
