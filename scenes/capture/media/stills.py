"""Stills of one camera among the pictures of a folder: one lens, one zoom, one shape.

A phone's photographs may be upright and wide, of several sizes, of its main and of its wide lens;
structure from motion here has one camera. A still that lies across the others is turned by a
quarter, so that its sensor lies as theirs; of several lenses the most common one is kept.
"""

import collections
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pi_heif
import PIL.ExifTags
import PIL.Image

from nerf2real.core.errors import first_few
from nerf2real.core.files import hash_path
from nerf2real.scenes.capture.media import colors
from nerf2real.scenes.capture.media.errors import CaptureError

APPLE_SUFFIXES = (".heic", ".heif")  # what iPhones write; OpenCV does not read them
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", *APPLE_SUFFIXES)
_JPEG_SUFFIXES = (".jpg", ".jpeg")  # decoded at a reduced size; OpenCV resamples other formats
_REDUCED = (
  (8, cv2.IMREAD_REDUCED_COLOR_8),
  (4, cv2.IMREAD_REDUCED_COLOR_4),
  (2, cv2.IMREAD_REDUCED_COLOR_2),
)
_ENOUGH = 1600  # long side at which features are sought: smaller pictures lose some [pixel]
_NAMED = 4  # files in a warning
_TURNED = (5, 6, 7, 8)  # EXIF orientations with width and height exchanged
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
      width, height = image.size
      exif = image.getexif()
      detail = exif.get_ifd(PIL.ExifTags.IFD.Exif)
  except (OSError, ValueError, SyntaxError) as error:
    raise CaptureError(
      f"{path} cannot be read as a picture: remove it or copy it again ({error})."
    ) from error
  if exif.get(PIL.ExifTags.Base.Orientation) in _TURNED:
    width, height = height, width
  focal = 0.0
  with contextlib.suppress(TypeError, ValueError):  # EXIF may hold several numbers, or text
    focal = float(detail.get(PIL.ExifTags.Base.FocalLengthIn35mmFilm, 0))
  return Look(width, height, focal if focal > 0 else None)


def unreadable(lost: Sequence[Path], count: int) -> list[str]:
  """Says which of `count` files cannot be read, if any."""
  if not lost:
    return []
  names = first_few([path.name for path in lost], _NAMED)
  return [f"{len(lost)} of {count} files cannot be read as a picture, left out: {names}."]


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
  features as the others. What is no picture is left out.

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
    CaptureError: It is damaged or no picture.
  """
  image, profile = None, None
  with contextlib.suppress(OSError, ValueError, SyntaxError), opened(path) as picture:
    profile = picture.info.get("icc_profile")
    if path.suffix.lower() in APPLE_SUFFIXES:  # libheif has turned it
      image = np.ascontiguousarray(np.asarray(picture.convert("RGB"))[..., ::-1])
  if path.suffix.lower() not in APPLE_SUFFIXES:
    how = _reduction(path, least) | (0 if upright else cv2.IMREAD_IGNORE_ORIENTATION)
    image = cv2.imread(str(path), how)
  if image is None:
    raise CaptureError(f"{path} cannot be read as a picture: remove it or copy it again.")
  return colors.to_srgb(image, profile)


def _reduction(path: Path, least: int | None) -> int:
  """OpenCV's flag to read a picture with: reduced as far as the long side that is needed allows."""
  if least is None or path.suffix.lower() not in _JPEG_SUFFIXES:
    return cv2.IMREAD_COLOR
  long_side = look_of(path).long_side
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
