"""Keyframes of a capture: what is known of them, and what may ruin a reconstruction from them."""

import dataclasses
import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from nerf2real.core.errors import first_few
from nerf2real.scenes.capture.posed.known_poses import KnownPoses

MIN_IMAGES = 8  # fewer pictures do not cover a room


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaptureSettings:
  """Settings of the keyframes and of the warnings."""

  num_keyframes: int = 150
  """Parts of the capture; the sharpest frame of each is kept. A video's are spread over its time
  and over what its picture moves, all others' are equal."""
  most_keyframes: int | None = None
  """Parts of a long video, which has two a second up to these, and of photographs, of which all are
  kept up to these; `num_keyframes` if None."""
  max_size: int = 1920
  """Long side of a keyframe; larger pictures are reduced [pixel]."""
  min_images: int = MIN_IMAGES
  """Fewer pictures are an error."""
  warn_duration: float = 15.0
  """a shorter walk does not see a room from enough places [s]."""
  warn_short_side: int = 480
  """a smaller picture has too few features [pixel]."""
  warn_blur: float = 2.9
  """Deviation of the blur from which a picture counts as blurred [pixel at the standard size]. Half
  of the contrast of the finest detail in a robot's picture is then lost: at 0.375 of its pixels,
  which in 60x80 span 7.6 of a phone's with a focal length of 1.2 short sides."""
  warn_blurred_fraction: float = 0.3
  """Of the keyframes that may be blurred without a warning."""
  warn_brightness_range: float = 3.0
  """95th to 5th percentile of the keyframes' mean brightness."""

  @property
  def most(self) -> int:
    """Keyframes of the longest video or of the most photographs."""
    return max(self.most_keyframes or 0, self.num_keyframes)


@dataclasses.dataclass(frozen=True)
class Capture:
  """Keyframes on disk and what is known about them. Shape: N keyframes."""

  kind: str
  """"video", "images", "colmap", "transforms" or "rgbd"."""
  folder: Path
  """Where the keyframes lie."""
  images: list[Path]
  """Keyframes, sorted by name."""
  width: int
  """Of every keyframe [pixel]."""
  height: int
  """Of every keyframe [pixel]."""
  sharpness: np.ndarray
  """Variance of the Laplacian at the standard size [N]."""
  brightness: np.ndarray
  """Mean grey level [N], 0 to 255."""
  blur: np.ndarray
  """Deviation of the blur along its widest direction at the standard size [N] [pixel]."""
  times: np.ndarray | None
  """In the video [N] [s]; None for pictures."""
  warnings: list[str]
  """What may ruin the reconstruction, one line each."""
  known: KnownPoses | None = None
  """Cameras that came with the pictures."""
  turned: np.ndarray | None = None
  """Keyframes that were turned counter-clockwise to lie as the others, bool [N]; None: none."""
  origins: list[str] | None = None
  """Names of the files that the keyframes were made of; None for a video."""

  @property
  def names(self) -> dict[str, str]:
    """The name of each keyframe's file, and of the file that whoever took it knows."""
    given = [path.name for path in self.images]
    return dict(zip(given, self.origins or given, strict=True))

  def told(self, text: str) -> str:
    """Replaces keyframes' names in a text by those that whoever took them knows."""
    names = self.names
    return re.sub("|".join(map(re.escape, names)), lambda found: names[found[0]], text)

  def called(self, chosen: np.ndarray, *, most: int) -> str:
    """Names up to `most` of chosen keyframes (bool [N]) as whoever took them knows them."""
    found = [name for name, wanted in zip(self.names.values(), chosen, strict=True) if wanted]
    return first_few(found, most)

  def without_place(self, placed: Collection[str]) -> str | None:
    """Names the stills that are not among the placed keyframes; None where all are, or of films."""
    lost = np.array([path.name not in placed for path in self.images])
    if self.origins is None or not lost.any():
      return None
    return (
      f"{lost.sum()} of {len(lost)} pictures have no place and are not used: "
      f"{self.called(lost, most=4)}. Each needs half of its view in common with others that were "
      "taken a step beside it."
    )

  @property
  def has_depth(self) -> bool:
    """Whether a sensor measured the keyframes' depth."""
    return self.known is not None and bool(self.known.depth_files)

  @property
  def unit_up(self) -> np.ndarray | None:
    """Up in the unit frame [3] where the cameras' axes do not show it, as some were turned."""
    return None if self.turned is None else np.array([0.0, 0.0, 1.0])


def quality_warnings(capture: Capture, settings: CaptureSettings) -> list[str]:
  """Returns warnings about the keyframes themselves; parallax is judged after matching."""
  found = []
  if min(capture.width, capture.height) < settings.warn_short_side:
    found.append(
      f"Low resolution: {capture.width}x{capture.height}, expected a short side of "
      f"{settings.warn_short_side} or more."
    )
  blurred = float(np.mean(capture.blur > settings.warn_blur))
  if blurred > settings.warn_blurred_fraction:
    found.append(
      f"Blur: {blurred:.0%} of the keyframes are blurred; move slower, add light, or lock the "
      "focus."
    )
  low, high = np.percentile(capture.brightness, [5, 95])
  if high > settings.warn_brightness_range * max(low, 1.0):
    found.append(
      f"Changing exposure or light: keyframes' mean brightness goes from {low:.0f} to {high:.0f}; "
      "lock the phone's exposure."
    )
  return found
