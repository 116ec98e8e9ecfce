"""Posed pictures to train and test a field on, and their blurred copies.

Shapes: N pictures, H height, W width, K blur levels.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.field import photometry

BLUR_LEVELS = (0.0, 0.7, 1.4, 2.8, 5.6, 12.0)  # chosen: an octave apart, up to the paper's 12
_SAMPLES_PER_BLUR = (
  1.4  # pixels of a smaller level in its blur, at least; chosen: above Nyquist's 1
)


def held_out_rows(count: int, every: int) -> np.ndarray:
  """Which of `count` pictures are kept from training, bool [count]: as LLFF, one of `every`."""
  held: np.ndarray = np.arange(count) % every == every // 2
  return held


@dataclasses.dataclass(frozen=True)
class Views:
  """Pictures of one camera with their poses in the unit frame."""

  camera: Camera
  images: np.ndarray
  """uint8 [N, H, W, 3]."""
  world_from_camera: np.ndarray
  """float64 [N, 4, 4], OpenCV camera axes."""
  names: tuple[str, ...]
  exposure: photometry.Exposure | None = None
  """Gains of the pictures and falloff of the lens; None where all have one exposure."""
  uneven: bool = False
  """Whether the exposure changed, also where it was evened out since."""
  anchors: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4), np.float32))
  """Known points [A, 4]: picture, pixel x and y, distance along the pixel's ray [unit]."""

  def __post_init__(self):
    count = len(self.images)
    size = (self.camera.height, self.camera.width, 3)
    if self.images.dtype != np.uint8 or self.images.shape[1:] != size:
      raise ValueError(
        f"Pictures are {self.images.dtype} {self.images.shape[1:]}, expected uint8 {size} as the "
        "camera says; resize the pictures or the camera."
      )
    if self.world_from_camera.shape != (count, 4, 4) or len(self.names) != count:
      raise ValueError(
        f"Found {count} pictures, poses {self.world_from_camera.shape}, {len(self.names)} names; "
        "expected one pose [4, 4] and one name a picture."
      )
    if self.exposure is not None and self.exposure.gains.shape != (count, 3):
      raise ValueError(
        f"Found gains {self.exposure.gains.shape}; expected [{count}, 3], a channel each."
      )
    if not np.isfinite(self.world_from_camera).all():
      raise ValueError("A camera pose is not finite; drop the pictures that were not localised.")

  def __len__(self) -> int:
    return len(self.images)

  def select(self, indices: Sequence[int] | np.ndarray) -> "Views":
    """Returns the chosen pictures."""
    indices = np.asarray(indices, np.int64)
    names = tuple(self.names[i] for i in indices)
    row = np.full(len(self), -1)
    row[indices] = np.arange(len(indices))
    anchors = self.anchors.copy()
    anchors[:, 0] = row[anchors[:, 0].astype(np.int64)]
    anchors = anchors[anchors[:, 0] >= 0]
    poses = self.world_from_camera[indices]
    exposure = None if self.exposure is None else self.exposure.select(indices)
    return Views(self.camera, self.images[indices], poses, names, exposure, self.uneven, anchors)

  def evened(self) -> "Views":
    """Returns the pictures as they would be with one exposure and no falloff, see `photometry`."""
    exposure = self.exposure
    if exposure is None:
      return self
    if exposure.is_even:
      return dataclasses.replace(self, exposure=None)
    images = np.stack(
      [
        photometry.even_out(image, exposure.factors(index, self.camera))
        for index, image in enumerate(self.images)
      ]
    )
    return dataclasses.replace(self, images=images, exposure=None, uneven=exposure.changes)

  def split(self, every: int = 8) -> tuple["Views", "Views"]:
    """Returns (training, held out): one of `every` pictures is held out, as LLFF does."""
    held = held_out_rows(len(self), every)
    if held.all() or not held.any():
      raise ValueError(
        f"Cannot hold out every {every}th of {len(self)} pictures; expected at least {every}."
      )
    return self.select(np.flatnonzero(~held)), self.select(np.flatnonzero(held))

  def resized(self, width: int, height: int) -> "Views":
    """Returns the pictures averaged over the pixels of a smaller size."""
    images = [
      cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in self.images
    ]
    camera = self.camera.resized(width, height)
    anchors = self.anchors.copy()
    anchors[:, 1] *= width / self.camera.width
    anchors[:, 2] *= height / self.camera.height
    return dataclasses.replace(self, camera=camera, images=np.stack(images), anchors=anchors)


@dataclasses.dataclass(frozen=True)
class BlurPyramid:
  """Every picture blurred by a few Gaussians; strong blurs are stored at a smaller size.

  A blur between two levels is mixed from them so that the variance is right.
  """

  levels: tuple[np.ndarray, ...]
  """uint8 [N, h, w, 3] each."""
  blurs: tuple[float, ...]
  """Standard deviation [pixel of the full size]."""
  factors: tuple[int, ...]
  """Full size / stored size."""

  @classmethod
  def build(cls, views: Views, *, blur_max: float) -> "BlurPyramid":
    """Blurs the pictures by `BLUR_LEVELS` scaled so that the last is `blur_max`."""
    if blur_max <= 0:
      return cls((views.images,), (0.0,), (1,))
    blurs = tuple(level * blur_max / BLUR_LEVELS[-1] for level in BLUR_LEVELS)
    levels, factors = [], []
    for blur in blurs:
      factor = 1
      while blur / (2 * factor) >= _SAMPLES_PER_BLUR:
        factor *= 2
      if blur == 0:
        levels.append(views.images)
      else:
        # Averaging over factor^2 pixels and reading bilinearly both blur a little themselves.
        own = (factor**2 - 1) / 12 + (factor**2 / 6 if factor > 1 else 0)
        rest = float(np.sqrt(max(blur**2 - own, 0.01)))
        levels.append(np.stack([_blurred(image, rest, factor) for image in views.images]))
      factors.append(factor)
    return cls(tuple(levels), blurs, tuple(factors))


def _blurred(image: np.ndarray, blur: float, factor: int) -> np.ndarray:
  """Averages over factor x factor pixels (the last ones over a repeated border), then blurs."""
  height, width = image.shape[:2]
  bottom, right = -height % factor, -width % factor
  small: np.ndarray = image.astype(np.float32)
  if factor > 1:
    small = cv2.copyMakeBorder(small, 0, bottom, 0, right, cv2.BORDER_REFLECT)
    size = ((width + right) // factor, (height + bottom) // factor)
    small = cv2.resize(small, size, interpolation=cv2.INTER_AREA)
  smooth = cv2.GaussianBlur(small, (0, 0), blur / factor, borderType=cv2.BORDER_REFLECT)
  return np.clip(np.rint(smooth), 0, 255).astype(np.uint8)
