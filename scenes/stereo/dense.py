"""Finds depth in posed pictures by dense stereo: anchors of a field's training.

Of few pictures a field finds little depth by itself, and localised points are sparse. A picture is
compared with those that see its known points from beside it; what its search finds counts where two
others' own searches found the same place.
Shapes: N pictures, H height, W width, h rows and w columns of pixels that look for depth, A points.
"""

import dataclasses

import cv2
import numpy as np

from nerf2real.core.geometry.cameras import PIXEL_CENTRE, Camera
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.field.views import Views
from nerf2real.scenes.stereo import patchmatch

_CLOSER = 0.6  # depths are sought from so much of the nearest known point's, and as far beyond
_SEEDS = 100_000  # between two pictures' random numbers: more than a search takes


@dataclasses.dataclass(frozen=True, kw_only=True)
class NeighbourSettings:
  """Settings of the choice; chosen, not tuned."""

  most: int = 5
  """Of each picture."""
  least_angle: float = 0.05
  """Between two pictures' sight lines to a point [rad]: with less its depth is uncertain."""
  most_angle: float = 0.6
  """With more patches look too different."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StereoSettings:
  """Settings of dense stereo; chosen, not tuned."""

  most_pictures: int = 64
  """Of more none is made; 0: never. Of many pictures a field finds depth by itself: with stereo
  between 64 of a film's, held-out pictures of a drawn room were 1.9 dB better, of a real living
  room as good, and the parts of neither, for two minutes more."""
  width: int = 640
  """Wider pictures are reduced to it [pixel]."""
  neighbours: NeighbourSettings = NeighbourSettings()
  """What each picture is compared with."""
  search: patchmatch.SearchSettings = patchmatch.SearchSettings()
  """The search for planes."""
  least_likeness: float = 0.7
  """Correlation of patches."""
  agreement: float = 0.01
  """Two pictures' depth of a place may differ by so much of it."""
  confirmations: int = 2
  """Other pictures whose own depth must agree."""
  points: int = 4000
  """Of a picture, at most."""


def _pinhole(views: Views, width: int) -> tuple[Camera, np.ndarray]:
  """Grey pictures float32 [N, H, W] in [0, 1] as a camera without distortion takes them, and it."""
  camera = views.camera.at_most(width)
  plain = dataclasses.replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
  at = (camera.project(plain.rays()) - PIXEL_CENTRE).astype(np.float32)
  pictures = []
  for image in views.images:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    grey = small.astype(np.float32) / 255
    # Beyond the picture its border goes on: a black margin would have an edge that moves with it.
    x, y = at[..., 0], at[..., 1]
    pictures.append(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
  return plain, np.stack(pictures)


def neighbours(views: Views, settings: NeighbourSettings) -> list[np.ndarray]:
  """Lists each picture's neighbours int [<= most], those first that see most of its anchors."""
  camera, eyes = views.camera, views.world_from_camera[:, :3, 3]
  size = np.array([camera.width, camera.height])
  owner = views.anchors[:, 0].astype(int)
  x, y = views.anchors[:, 1:3].astype(int).T
  every = camera.rays()
  widest = np.square(every[..., :2]).sum(-1).max()  # farther out a lens may fold back
  rays = every[y, x]
  ways = np.einsum("aij,aj->ai", views.world_from_camera[owner, :3, :3], rays)
  ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
  points = eyes[owner] + views.anchors[:, 3:] * ways
  found = []
  for n in range(len(views)):
    mine, way = points[owner == n], ways[owner == n]
    scores = np.zeros(len(views), int)
    for k, pose in enumerate(views.world_from_camera):
      if k == n or pose[:3, 2] @ views.world_from_camera[n, :3, 2] <= 0:
        continue
      offset = mine - eyes[k]
      local = offset @ pose[:3, :3]
      ahead = np.square(local[:, :2]).sum(-1) < widest * np.square(np.maximum(local[:, 2], 0))
      pixel = camera.project(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
      cosine = (offset * way).sum(-1) / np.maximum(np.linalg.norm(offset, axis=-1), 1e-12)
      angle = np.arccos(np.clip(cosine, -1, 1))
      seen = ahead & ((pixel >= 0) & (pixel < size)).all(-1)
      scores[k] = (seen & (angle > settings.least_angle) & (angle < settings.most_angle)).sum()
    order = np.argsort(-scores, kind="stable")[: settings.most]
    found.append(order[scores[order] > 0])
  return found


class _Search:
  """Depth of all pictures, each by comparing it with its neighbours."""

  def __init__(self, views: Views, settings: StereoSettings):
    self.settings = settings
    self.views = views
    self.camera, self.pictures = _pinhole(views, settings.width)
    self.camera_from_world = np.linalg.inv(views.world_from_camera)
    self.others = neighbours(views, settings.neighbours)
    stride = settings.search.stride
    grid = np.meshgrid(*(np.arange(0, n, stride) for n in (self.camera.width, self.camera.height)))
    self.rays = self.camera.rays(np.stack(grid, -1) + PIXEL_CENTRE)
    shape = (len(views), *self.rays.shape[:2])
    self.depth, self.likeness = np.zeros(shape, np.float32), np.full(shape, -1, np.float32)

  def find(self, n: int) -> None:
    """Searches one picture's depth, from its known points and at random elsewhere."""
    others = self.others[n]
    known = self.views.anchors[self.views.anchors[:, 0] == n]
    if len(others) < patchmatch.BEST or not len(known):
      return
    x, y = known[:, 1:3].astype(int).T
    pixels = np.column_stack([x, y]) + PIXEL_CENTRE
    z = known[:, 3] / np.linalg.norm(self.views.camera.rays(pixels), axis=-1)
    near, far = _CLOSER * np.percentile(z, 1), np.percentile(z, 99) / _CLOSER
    inverse = np.random.default_rng(n).uniform(1 / far, 1 / near, self.depth.shape[1:])
    first = (1 / inverse).astype(np.float32)
    cell = pixels * self.camera.size_ratio(self.views.camera) / self.settings.search.stride
    column, row = np.minimum(cell.astype(int), np.array(first.shape[::-1]) - 1).T
    first[row, column] = z
    move = (self.camera_from_world[others] @ self.views.world_from_camera[n]).astype(np.float32)
    camera = self.camera
    self.depth[n], self.likeness[n] = patchmatch.search(
      self.pictures[n],
      patchmatch.Others(
        self.pictures[others],
        np.ascontiguousarray(move[:, :3, :3]),
        np.ascontiguousarray(move[:, :3, 3]),
      ),
      (camera.fx, camera.fy, camera.cx - PIXEL_CENTRE, camera.cy - PIXEL_CENTRE),
      first=first,
      near=near,
      far=far,
      settings=self.settings.search,
      seed=_SEEDS * n,
    )

  def confirmed(self, n: int) -> np.ndarray:
    """Whose depth other pictures' own confirm, bool [h, w]."""
    settings, size = self.settings, np.array(self.depth.shape[:0:-1])
    points = self.rays * self.depth[n][..., None]
    count = np.zeros(points.shape[:2], int)
    for k in self.others[n]:
      move = self.camera_from_world[k] @ self.views.world_from_camera[n]
      local = points @ move[:3, :3].T + move[:3, 3]
      ahead = local[..., 2] > 0
      pixel = self.camera.project(np.where(ahead[..., None], local, [0.0, 0.0, 1.0]))
      at = np.rint((pixel - PIXEL_CENTRE) / settings.search.stride).astype(int)
      inside = ahead & ((at >= 0) & (at < size)).all(-1)
      column, row = np.where(inside[..., None], at, 0).transpose(2, 0, 1)
      same = np.abs(self.depth[k][row, column] - local[..., 2]) < settings.agreement * local[..., 2]
      count += inside & same & (self.likeness[k][row, column] > settings.least_likeness)
    sure: np.ndarray = self.likeness[n] > settings.least_likeness
    return sure & (count >= settings.confirmations)

  def points(self, n: int) -> np.ndarray:
    """Confirmed points of a picture as anchors [A, 4]; of many some, at random."""
    places = np.random.default_rng(n).permutation(np.argwhere(self.confirmed(n)))
    row, column = places[: self.settings.points].T
    rays = self.rays[row, column]
    camera = self.views.camera
    pixel = np.floor(camera.project(rays))
    distance = self.depth[n][row, column] * np.linalg.norm(rays, axis=-1)
    inside = ((pixel >= 0) & (pixel < [camera.width, camera.height])).all(-1)
    found = np.column_stack([np.full(len(pixel), n), pixel, distance])
    return found[inside].astype(np.float32)


def dense_points(
  views: Views, settings: StereoSettings | None = None, *, progress: Progress = no_progress
) -> np.ndarray:
  """Finds points by dense stereo between pictures whose known points say how deep they see.

  Args:
    views: Pictures of even exposure with anchors.
    settings: Settings.
    progress: Called with the fraction done and a text.

  Returns:
    float32 [A, 4] as `Views.anchors`: picture, pixel x and y, distance along the ray [unit].
  """
  search = _Search(views, settings or StereoSettings())
  for n in range(len(views)):
    search.find(n)
    progress((n + 1) / len(views), f"stereo, picture {n + 1} of {len(views)}")
  return np.concatenate([search.points(n) for n in range(len(views))])
