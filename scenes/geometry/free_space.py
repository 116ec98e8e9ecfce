"""Free space of a floor: reachability, clearance, sampling, grids and paths for a robot's centre.

`FreeSpace` derives grids, nearest places and room around a place from the reachability of points;
`FreeSpaceMap` takes that from an occupancy map of the convex parts.
Shapes: H rows along y, W columns along x (row 0 is the smallest y in memory); X, Y cells of a grid.
"""

import abc
import bisect
import dataclasses
import functools

import numpy as np
from scipy import ndimage
from skimage import graph

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # grey values of ROS map_server


class FreeSpaceError(ValueError):
  """There is no place to stand."""


def _cells_to_blocked(free: np.ndarray) -> np.ndarray:
  """Distance of every free cell from the nearest that is not, centre to centre, in cells."""
  return ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]


@dataclasses.dataclass(frozen=True)
class FloorGrid:
  """The reachable floor, sampled at the centres of square cells."""

  free: np.ndarray
  """bool [X, Y]."""
  centres: np.ndarray
  """[X, Y, 2] world x, y [m]."""
  lower: np.ndarray
  """[2] lower corner of cell (0, 0) [m]."""
  cell: float
  """Edge of a cell [m]."""

  @functools.cached_property
  def clearance(self) -> np.ndarray:
    """Distance of a free cell's centre from the nearest centre that is not free [X, Y] [m]."""
    return _cells_to_blocked(self.free) * self.cell

  def index_of(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Cells of world points [..., 2] as a pair of indices [...]; the nearest for those outside."""
    index = np.floor((np.asarray(points, np.float64) - self.lower) / self.cell).astype(int)
    return tuple(np.moveaxis(np.clip(index, 0, np.array(self.free.shape) - 1), -1, 0))

  def path(self, start: np.ndarray, goal: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Points [N, 2] of the path of least cost [X, Y] per length, ends included [m]."""
    cells, _ = graph.route_through_array(
      cost, self.index_of(start), self.index_of(goal), fully_connected=True, geometric=True
    )
    points = self.lower + self.cell * (np.array(cells) + 0.5)
    points[0], points[-1] = start, goal
    return points


class FreeSpace(abc.ABC):
  """The places on a floor where the centre of a robot can be."""

  @abc.abstractmethod
  def is_reachable(self, points: np.ndarray) -> np.ndarray:
    """Whether the robot can be centred at points [..., >= 2], bool [...]."""

  @abc.abstractmethod
  def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses x, y, yaw [count, 3] where the robot can be [m, rad]."""

  def grid(self, extent: tuple[np.ndarray, np.ndarray], cell: float) -> FloorGrid:
    """Samples the floor between the corners [>= 2] of an extent in cells of an edge [m]."""
    lower, upper = (np.asarray(corner, np.float64)[:2] for corner in extent)
    x, y = (np.arange(lower[i] + cell / 2, upper[i], cell) for i in range(2))
    centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    return FloorGrid(np.asarray(self.is_reachable(centres), bool), centres, lower, cell)

  def nearest_reachable(self, point: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The point [2] itself where it is reachable, or else the nearest reachable of others [N, 2].

    Raises:
      FreeSpaceError: None is.
    """
    if self.is_reachable(point):
      return point
    free = others[np.asarray(self.is_reachable(others), bool)]
    if not len(free):
      raise FreeSpaceError(
        f"Found no place to stand among {len(others)} around {np.round(point, 2).tolist()}: use a "
        "scene with more room."
      )
    return free[np.argmin(np.linalg.norm(free - point, axis=1))]

  def has_room(self, places: np.ndarray, room: float) -> np.ndarray:
    """Whether the robot fits at places [N, 2] moved by up to a distance [m], bool [N].

    Tried at 16 directions, at the distance and at half of it.
    """
    angles = 2 * np.pi * np.arange(16) / 16
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    around = np.concatenate([room * ring, room / 2 * ring])
    return np.all(self.is_reachable(places[:, None] + around), axis=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FreeSpaceMap(FreeSpace):
  """An occupancy map of the ground."""

  cells: np.ndarray
  """uint8 [H, W], FREE, OCCUPIED or UNKNOWN; row 0 is the smallest y."""
  resolution: float
  """m."""
  origin: np.ndarray
  """[2] world x, y of the map's lower left corner [m]."""
  radius: float
  """Of the robot [m]."""

  @functools.cached_property
  def clearance(self) -> np.ndarray:
    """Distance from a cell's centre to the nearest cell that is not free [H, W] [m]."""
    return np.maximum(_cells_to_blocked(self.cells == FREE) - 0.5, 0) * self.resolution

  @functools.cached_property
  def reachable(self) -> np.ndarray:
    """Cells where the robot's centre can be, bool [H, W]: the largest connected piece."""
    labels, count = ndimage.label(self._roomy)
    if count == 0:
      return self._roomy
    return labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])

  @property
  def _roomy(self) -> np.ndarray:
    """Cells that have room for the robot, bool [H, W]."""
    return self.clearance >= self.radius

  @property
  def area(self) -> float:
    """Reachable area [m^2]."""
    return float(self.reachable.sum() * self.resolution**2)

  @property
  def area_apart(self) -> float:
    """Area where the robot fits, too, but that it cannot reach from there [m^2]."""
    return float(self._roomy.sum() * self.resolution**2) - self.area

  @property
  def passage_lacks(self) -> float | None:
    """Width that the widest way to the largest piece apart lacks for the robot [m].

    None where there is no piece apart, or no way to it at all.
    """
    labels, count = ndimage.label(self._roomy)
    if count < 2:
      return None
    first, second = np.argsort(np.bincount(labels.ravel())[1:])[::-1][:2] + 1
    here, there = (tuple(np.argwhere(labels == piece)[0]) for piece in (first, second))
    widths = np.unique(self.clearance[(self.clearance > 0) & (self.clearance < self.radius)])

    def joined(width: float) -> bool:
      found, _ = ndimage.label(self.clearance >= width)
      return bool(found[here] == found[there])

    if not len(widths) or not joined(widths[0]):
      return None
    # The widest at which both are one: joined at all smaller ones.
    last = bisect.bisect_left(widths, True, key=lambda width: not joined(width)) - 1
    return float(2 * (self.radius - widths[last]))

  def cell_of(self, points: np.ndarray) -> np.ndarray:
    """Row and column [..., 2] of world points [..., >= 2]; may lie outside the map."""
    index = np.floor((np.asarray(points)[..., :2] - self.origin) / self.resolution).astype(int)
    return index[..., ::-1]

  def is_reachable(self, points: np.ndarray) -> np.ndarray:
    """Whether the robot can be centred at points [..., >= 2], bool [...]; not outside the map."""
    index = self.cell_of(points)
    inside = np.all((index >= 0) & (index < self.cells.shape), axis=-1)
    index = np.where(inside[..., None], index, 0)
    return inside & self.reachable[index[..., 0], index[..., 1]]

  def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses x, y, yaw [count, 3], uniform over the reachable area and all directions [m, rad]."""
    places = np.argwhere(self.reachable)
    if len(places) == 0:
      raise FreeSpaceError(self.why_full)
    chosen = places[rng.integers(0, len(places), count)][:, ::-1] + rng.random((count, 2))
    yaw = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([self.origin + self.resolution * chosen, yaw])

  def roomiest(self) -> np.ndarray:
    """Pose x, y, yaw [3] at the reachable place that is farthest from everything, yaw 0 [m].

    Raises:
      FreeSpaceError: There is no place to stand.
    """
    if not self.reachable.any():
      raise FreeSpaceError(self.why_full)
    space = np.where(self.reachable, self.clearance, -1)
    row, column = np.unravel_index(np.argmax(space), space.shape)
    return np.array([*(self.origin + self.resolution * (np.array([column, row]) + 0.5)), 0.0])

  def default_goals(self, *, count: int = 3, clearance: float = 0.15) -> np.ndarray:
    """Goals [count, 2] that lie far apart along the paths a robot must take, with room around.

    The first is the farthest place from the middle of the free space, each further one the farthest
    from those before.
    """
    reachable = self.reachable
    if not reachable.any():
      raise FreeSpaceError(self.why_full)
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

  @property
  def why_full(self) -> str:
    """What to say where there is no place to stand."""
    share = (self.cells == FREE).mean()
    return (
      f"Found no place where a robot of radius {self.radius:g} m fits: {100 * share:.0f} % of the "
      "map is free, nowhere wide enough. Check the scale, the floor and the collision parts."
    )
