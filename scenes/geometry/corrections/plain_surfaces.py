"""Puts plain surfaces onto the planes that the texture at their border lies on.

Nothing in a picture tells how far the middle of a plain wall is: a surface behind it looks the
same, and the field's sags by decimetres. Where there is texture depth is right. So a plain region
of a picture is taken for the one or two upright or level planes on which most of what borders it
lies: walls, doors and cupboards stand, floors, tables and shelves are level. What borders it and is
nearer may hide the rest of it and says nothing; what is farther speaks against the plane, as the
region then ends there.
Source of the assumption that a region of one colour is a plane on what is known at its points:
Bodis-Szomoru, Riemenschneider and Van Gool 2014, "Fast, approximate piecewise-planar modeling based
on sparse structure-from-motion and superpixels". Shapes: N views, H height, W width, P pixels of a
border, K planes.
"""

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np

from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.geometry import fusion

_WINDOW = 5  # pixels, edge of the patch whose contrast is asked
_PLAIN, _TEXTURED = 2.0, 3.0  # grey levels of its deviation
_SMALLEST = 150  # pixels of a region
_BORDER = 8  # pixels around a region whose texture is asked
_FEWEST = 40  # of them that tell of a plane
_NOISE, _SHARE = 0.01, 0.005  # m, and of the depth: how far off depth is where there is texture
_CLEAR = 3.0  # times that: clearly nearer or farther than a plane
_DRAWS = 200  # pairs of points that upright planes are drawn through, and a quarter of level ones
_APART = 0.15  # m between the points of a pair on the floor
_GRAZING = 0.05  # least sine of a ray to a plane
_UP = np.array([0.0, 0.0, 1.0])

# Chosen on four drawn rooms:
_ON = 0.4  # least share on the planes, of what borders the region and is not nearer
_AROUND = 0.5  # least share of the region's width and of its height that these span
_FARTHER = 0.1  # most of what borders it that is farther than the planes
_SECOND = 0.25  # least share of it that a second plane is looked for in
FARTHEST = 1.0  # m that a pixel is moved at most


def on_planes(views: fusion.DepthViews, *, progress: Progress = no_progress) -> fusion.DepthViews:
  """Returns depth pictures whose plain regions lie on planes where what borders them does.

  Args:
    views: Depth pictures with colours in the world frame (metres, z up).
    progress: Called with the fraction done and a text.

  Raises:
    ValueError: Where the views have no colours.
  """
  pictures = colors(views)
  rays = views.camera.rays()
  depth = views.depth.copy()
  for index, pose in enumerate(views.frame_from_camera):
    own = np.where(np.isfinite(depth[index]), depth[index], 0).astype(np.float32)
    pixels = _Pixels(own, rays @ pose[:3, :3].T, pose[:3, 3])
    on_surface = fusion.pixel_normals(own, rays)[1] > 0
    for region, border in _regions(pictures[index], on_surface):
      target = _planes(pixels, region, border)
      if target is not None:
        moved = region & (own > 0) & (np.abs(target - own) < FARTHEST)
        depth[index][moved] = target[moved]
    progress((index + 1) / len(depth), "plain surfaces")
  return dataclasses.replace(views, depth=depth)


def colors(views: fusion.DepthViews) -> np.ndarray:
  """Returns the colours uint8 [N, H, W, 3] of depth pictures; raises ValueError without any."""
  if views.color is None:
    raise ValueError("Depth pictures have no colours: what is plain in them is not known.")
  return views.color


def clearly(depth: np.ndarray) -> np.ndarray:
  """By how much [...] two depths [...] differ that are clearly not of one surface [m]."""
  return _CLEAR * (_NOISE + _SHARE * depth)


def is_plain(color: np.ndarray) -> np.ndarray:
  """Which pixels of a picture uint8 [H, W, 3] have nothing around them that tells where they are,
  bool [H, W]."""
  return _contrast(color) < _PLAIN


def _contrast(color: np.ndarray) -> np.ndarray:
  grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)
  mean, square = (cv2.blur(values, (_WINDOW, _WINDOW)) for values in (grey, grey * grey))
  contrast: np.ndarray = np.sqrt(np.maximum(square - mean * mean, 0))
  return contrast


@dataclasses.dataclass(frozen=True)
class _Pixels:
  """Pixels [...] of a view: their depth, their rays [..., 3] in the world and where these begin."""

  depth: np.ndarray
  rays: np.ndarray
  origin: np.ndarray

  def where(self, mask: np.ndarray) -> "_Pixels":
    """Those of a mask [...]."""
    return _Pixels(self.depth[mask].astype(np.float64), self.rays[mask], self.origin)

  @property
  def points(self) -> np.ndarray:
    """Where their surface is [..., 3]."""
    return self.origin + self.rays * self.depth[..., None]

  @property
  def noise(self) -> np.ndarray:
    """How far off depth is where there is texture [...]."""
    return _NOISE + _SHARE * self.depth

  def meeting(self, normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Depth [K, ...] at which rays meet planes [K, 3], [K]; inf where they graze or never do."""
    toward = np.tensordot(normals, self.rays, (1, -1))
    steep = np.abs(toward) > _GRAZING * np.linalg.norm(self.rays, axis=-1)
    height = (offsets - normals @ self.origin).reshape(-1, *[1] * self.depth.ndim)
    at: np.ndarray = height / np.where(steep, toward, 1.0)
    return np.where(steep & (at > 0), at, np.inf)


def _regions(color: np.ndarray, on_surface: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
  """Yields plain regions of a picture and what borders them and has texture, both bool [H, W]."""
  contrast = _contrast(color)
  plain = cv2.erode((contrast < _PLAIN).astype(np.uint8), np.ones((3, 3), np.uint8))
  textured = (contrast > _TEXTURED) & on_surface
  around = np.ones((2 * _BORDER + 1,) * 2, np.uint8)
  count, labels, stats, _ = cv2.connectedComponentsWithStats(plain, connectivity=4)
  for label in range(1, count):
    if stats[label, cv2.CC_STAT_AREA] >= _SMALLEST:
      region = labels == label
      yield region, textured & (cv2.dilate(region.astype(np.uint8), around) > 0) & ~region


def _planes(view: _Pixels, region: np.ndarray, border: np.ndarray) -> np.ndarray | None:
  """The depth [H, W] of the planes that what borders a region lies on; None where it does not."""
  seen = view.where(border)
  left, on = np.ones(len(seen.depth), bool), np.zeros(len(seen.depth), bool)
  found: list[tuple[np.ndarray, np.ndarray]] = []
  while len(found) < 2 and left.sum() >= max(_SECOND * len(left), _FEWEST / 2):
    plane = _fullest_plane(seen.where(left))
    off = seen.meeting(*plane)[0] - seen.depth
    inside, nearer = left & (np.abs(off) < seen.noise), left & (off > clearly(seen.depth))
    if inside.sum() < max(_ON * (left & ~nearer).sum(), _FEWEST / 2):
      break
    found.append(plane)
    on |= inside
    left &= ~inside
  if not found:
    return None
  at = np.min([seen.meeting(*plane)[0] for plane in found], axis=0)
  farther = seen.depth - at > clearly(seen.depth)
  around = all(
    np.ptp(theirs[on]) >= _AROUND * np.ptp(own)
    for theirs, own in zip(np.nonzero(border), np.nonzero(region), strict=True)
  )
  if farther.mean() > _FARTHER or not around:
    return None
  target: np.ndarray = np.min([view.meeting(*plane)[0] for plane in found], axis=0)
  return target


def _fullest_plane(seen: _Pixels) -> tuple[np.ndarray, np.ndarray]:
  """The upright or level plane that most pixels lie on: normal [1, 3] and offset [1]."""
  points = seen.points
  pairs = points[np.random.default_rng(0).choice(len(points), (_DRAWS, 2))]
  along = pairs[:, 1, :2] - pairs[:, 0, :2]
  length = np.linalg.norm(along, axis=-1)
  far, level = length > _APART, pairs[: _DRAWS // 4, 0]
  upright = np.stack([-along[:, 1], along[:, 0], np.zeros(_DRAWS)], -1)[far] / length[far, None]
  normals = np.concatenate([upright, np.tile(_UP, (len(level), 1))])
  through = np.concatenate([pairs[far, 0], level])
  inside = np.abs(seen.meeting(normals, (normals * through).sum(-1)) - seen.depth) < seen.noise
  best = int(inside.sum(-1).argmax())
  own, normal = points[inside[best]], normals[best]
  if len(own) > 2 and not normal[2]:
    across = np.linalg.svd(own[:, :2] - own[:, :2].mean(0), full_matrices=False)[2][1]
    normal = np.array([*across, 0.0])
  centre = own.mean(0) if len(own) else through[best]
  return normal[None], np.array([normal @ centre])
