"""The free-space map: where a robot of given radius and height can stand, and where to send it.

The map is a top-down projection of the convex parts. Files follow ROS map_server: a PGM whose
first row is the largest y, and a YAML with resolution and the lower left corner.
Shapes: H rows along y, W columns along x (row 0 is the smallest y in memory).
"""

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import yaml
from scipy import ndimage
from skimage import graph

from nerf2real.core.progress import Progress, no_progress

if TYPE_CHECKING:  # a robot's host reads maps, and builds none
  from nerf2real.scenes.geometry import convex, fusion

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # map_server's grey values


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeSpaceSettings:
  """The robot and the map; lengths in metres."""

  resolution: float = 0.04  # edge of a cell
  radius: float = 0.18  # of the robot: OP3's shoulders are 0.3 m apart, plus its sway
  low: float = 0.02  # lower matter is stepped over or is floor
  high: float = 0.6  # matter above passes over the robot's head: OP3 is 0.51 m tall
  goals: int = 3  # paper, section "Robot navigation": three targets
  goal_clearance: float = 0.15  # more room at a goal than a robot needs to stand


class FreeSpaceError(ValueError):
  """There is no place to stand."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeSpace:
  """A map of the ground."""

  cells: np.ndarray  # uint8 [H, W], FREE, OCCUPIED or UNKNOWN; row 0 is the smallest y
  resolution: float  # m
  origin: np.ndarray  # [2] world x, y of the map's lower left corner [m]
  radius: float  # of the robot [m]

  @functools.cached_property
  def clearance(self) -> np.ndarray:
    """Distance from a cell's centre to the nearest cell that is not free [H, W] [m]."""
    padded = np.pad(self.cells == FREE, 1)
    distance = ndimage.distance_transform_edt(padded)[1:-1, 1:-1] - 0.5
    return np.maximum(distance, 0) * self.resolution

  @functools.cached_property
  def reachable(self) -> np.ndarray:
    """Cells where the robot's centre can be, bool [H, W]: the largest connected piece."""
    wide = self.clearance >= self.radius
    labels, count = ndimage.label(wide)
    if count == 0:
      return wide
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])

  def cell_of(self, points: np.ndarray) -> np.ndarray:
    """Row and column [..., 2] of world points [..., >= 2]; may lie outside the map."""
    index = np.floor((np.asarray(points)[..., :2] - self.origin) / self.resolution).astype(int)
    return index[..., ::-1]

  def is_reachable(self, points: np.ndarray) -> np.ndarray:
    """Whether the robot can be centred at points [..., >= 2], bool [...]."""
    index = self.cell_of(points)
    inside = np.all((index >= 0) & (index < self.cells.shape), axis=-1)
    index = np.where(inside[..., None], index, 0)
    return inside & self.reachable[index[..., 0], index[..., 1]]

  def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses x, y, yaw [count, 3], uniform over the reachable area and all directions [m, rad]."""
    places = np.argwhere(self.reachable)
    if len(places) == 0:
      raise FreeSpaceError(self._full())
    chosen = places[rng.integers(0, len(places), count)][:, ::-1] + rng.random((count, 2))
    yaw = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([self.origin + self.resolution * chosen, yaw])

  def default_goals(self, *, count: int = 3, clearance: float = 0.15) -> np.ndarray:
    """Goals [count, 2] that lie far apart along the paths a robot must take, with room around.

    The first is the farthest place from the middle of the free space, each further one the farthest
    from those before.
    """
    reachable = self.reachable
    if not reachable.any():
      raise FreeSpaceError(self._full())
    space = np.where(reachable, self.clearance, 0)
    wide = space >= min(self.radius + clearance, np.quantile(space[reachable], 0.7))
    cost = np.where(reachable, 1.0, np.inf)
    starts = [tuple(np.unravel_index(np.argmax(space), space.shape))]
    goals: list[tuple[int, ...]] = []
    while len(goals) < count:
      distance, _ = graph.MCP_Geometric(cost).find_costs(goals or starts)
      distance = np.where(wide & np.isfinite(distance), distance, -1)
      goals.append(tuple(int(i) for i in np.unravel_index(np.argmax(distance), distance.shape)))
    return self.origin + self.resolution * (np.array(goals)[:, ::-1] + 0.5)

  def _full(self) -> str:
    share = (self.cells == FREE).mean()
    return (
      f"Found no place where a robot of radius {self.radius:g} m fits: {100 * share:.0f} % of the "
      "map is free, nowhere wide enough. Check the scale, the floor and the collision parts."
    )

  def write(self, path: pathlib.Path) -> None:
    """Writes path (.pgm) and the .yaml beside it, in ROS map_server's convention."""
    height, width = self.cells.shape
    header = f"P5\n# free space for a robot of radius {self.radius:g} m\n{width} {height}\n255\n"
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(self.cells[::-1]).tobytes())
    path.with_suffix(".yaml").write_text(
      f"image: {path.name}\nmode: trinary\nresolution: {float(self.resolution)!r}\n"
      f"origin: [{float(self.origin[0])!r}, {float(self.origin[1])!r}, 0.0]\n"
      "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
      f"robot_radius: {float(self.radius)!r}\n",
      encoding="ascii",
    )


def read(path: pathlib.Path) -> FreeSpace:
  """Reads a map: the .yaml, or the .pgm beside it.

  Raises:
    ValueError: a missing or damaged file, or a rotated map.
  """
  path = path.with_suffix(".yaml")
  if not path.is_file():
    raise ValueError(f"The map {path} does not exist.")
  try:
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
  except (yaml.YAMLError, UnicodeDecodeError) as error:
    reason = " ".join(str(error).split())
    message = f"The map {path} is no YAML file ({reason}): make the bundle again."
    raise ValueError(message) from error
  if not isinstance(about, dict):
    raise ValueError(f"The map {path} holds {about!r}; expected names and values.")
  missing = {"image", "resolution", "origin"} - set(about)
  if missing:
    raise ValueError(f"The map {path} lacks {', '.join(sorted(missing))}.")
  if len(about["origin"]) > 2 and about["origin"][2]:
    raise ValueError(f"The map {path} is turned by {about['origin'][2]} rad; expected 0.")
  image = cv2.imread(str(path.parent / about["image"]), cv2.IMREAD_GRAYSCALE)
  if image is None:
    raise ValueError(f"Cannot read the map's picture {path.parent / about['image']}.")
  share = image / 255.0 if about.get("negate") else 1 - image / 255.0
  cells = np.full(image.shape, UNKNOWN, np.uint8)
  cells[share > about.get("occupied_thresh", 0.65)] = OCCUPIED
  cells[share < about.get("free_thresh", 0.196)] = FREE
  return FreeSpace(
    cells=cells[::-1].copy(),
    resolution=float(about["resolution"]),
    origin=np.array(about["origin"][:2], np.float64),
    radius=float(about.get("robot_radius", 0.0)),
  )


def _shadow(part: "convex.Part", low: float, high: float) -> np.ndarray | None:
  """Corners [K, 2] of what a convex part covers between two heights; None if it is elsewhere.

  A convex body's slab is convex, so its shadow is the hull of its corners: the part's own within
  the slab and those of its edges with both planes.
  """
  v = part.vertices
  if v[:, 2].max() < low or v[:, 2].min() > high:
    return None
  edges = np.concatenate([part.faces[:, [0, 1]], part.faces[:, [1, 2]], part.faces[:, [2, 0]]])
  found = [v[(v[:, 2] >= low) & (v[:, 2] <= high), :2]]
  for level in (low, high):
    a, b = v[edges[:, 0]], v[edges[:, 1]]
    crosses = (a[:, 2] - level) * (b[:, 2] - level) < 0
    a, b = a[crosses], b[crosses]
    found.append((a + (b - a) * ((level - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None])[:, :2])
  corners = np.concatenate(found)
  return corners if len(corners) else None


def free_space(
  parts: Sequence["convex.Part"],
  *,
  lower: np.ndarray,
  upper: np.ndarray,
  seen: "fusion.Grid | None" = None,
  settings: FreeSpaceSettings | None = None,
  progress: Progress = no_progress,
) -> FreeSpace:
  """Maps the ground inside an extent.

  Args:
    parts: Convex parts, world frame.
    lower: Lower corner of the extent, [>= 2].
    upper: Upper corner of the extent, [>= 2].
    seen: Fused depth, world frame: columns that no ray ever crossed at the robot's height are
    unknown
      and no place to stand. Without it everything inside the extent counts as seen.
    settings: Settings.
    progress: Called with the fraction done and a text.
  """
  settings = settings or FreeSpaceSettings()
  origin, size = np.asarray(lower[:2], np.float64), settings.resolution
  width, height = np.maximum(np.ceil((np.asarray(upper[:2]) - origin) / size).astype(int), 1)
  blocked = np.zeros((height, width), np.uint8)
  for number, part in enumerate(parts):
    corners = _shadow(part, settings.low, settings.high)
    if corners is not None:
      # Cell (0, 0) has its centre at half a cell; fillConvexPoly takes 1/16 of a cell.
      pixels = np.round(((corners - origin) / size - 0.5) * 16).astype(np.int32)
      cv2.fillConvexPoly(blocked, cv2.convexHull(pixels), 1, shift=4)
    progress((number + 1) / len(parts), "free space")
  cells = np.where(blocked > 0, OCCUPIED, FREE).astype(np.uint8)
  if seen is not None:
    heights = seen.centres(2)
    band = (heights >= settings.low) & (heights <= settings.high)
    known = (seen.observed & ~seen.solid)[:, :, band].any(-1)
    x = origin[0] + size * (np.arange(width) + 0.5)
    y = origin[1] + size * (np.arange(height) + 0.5)
    i = np.round((x - seen.lower[0]) / seen.voxel).astype(int)
    j = np.round((y - seen.lower[1]) / seen.voxel).astype(int)
    inside = ((i >= 0) & (i < known.shape[0]))[None] & ((j >= 0) & (j < known.shape[1]))[:, None]
    i, j = np.clip(i, 0, known.shape[0] - 1), np.clip(j, 0, known.shape[1] - 1)
    cells[(~(known[i][:, j].T & inside)) & (cells == FREE)] = UNKNOWN
  return FreeSpace(cells=cells, resolution=size, origin=origin, radius=settings.radius)
