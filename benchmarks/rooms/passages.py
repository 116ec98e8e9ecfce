"""What narrows a passage: how far before the truth contact geometry of the built-in room begins.

  python benchmarks/rooms/passages.py --views 50

Depth of a bundle's field becomes the voxels, the parts and the map of the free floor that a robot
gets. At the border of each, where a robot would be stopped, the distance to the true matter of the
robot's height is taken: positive in front of it, negative within. Their differences are what noise
and voxels, convex parts and the map's cells each take of a passage, on each of its two sides.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks import harness
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.core.serialization import from_plain
from nerf2real.scenes.builtin import furniture, room, solids
from nerf2real.scenes.bundle import Bundle
from nerf2real.scenes.export import views
from nerf2real.scenes.geometry import collision, decomposition, floor_plan, fusion
from nerf2real.scenes.settings import SceneSettings

_FINE = 0.005  # m, cells in which borders of voxels and of parts are found
_HEIGHTS = 0.03  # m between heights at which matter is looked for
_INSIDE = 0.1  # m from the room's walls and doors within which a border counts
_REACH = 0.12  # m: a border that is farther from true matter is of matter that is not there
_TOO_DEEP = 0.025  # m: more than parts may reach


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which scene, and with how many pictures."""

  scene: Path | None = None
  """Folder of a bundle of the built-in room; the shipped one if not given."""
  views: int = 50
  """Depth pictures of the field."""
  tolerance: tuple[float, ...] = (decomposition.ConvexSettings().tolerance,)
  """How far parts may reach into seen free space [m]; the preset's if not given."""


def _border(blocked: np.ndarray, origin: np.ndarray, cell: float) -> np.ndarray:
  """Places [B, 2] on the border of the blocked cells [H, W] towards the largest free piece."""
  labels, count = ndimage.label(~blocked)
  if not count:
    return np.zeros((0, 2))
  free = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
  found = []
  for axis in (0, 1):
    ahead = np.argwhere(np.diff(free.astype(np.int8), axis=axis) != 0).astype(float)
    ahead[:, axis] += 0.5  # between the two cells' centres
    found.append(ahead)
  return origin + cell * (np.concatenate(found)[:, ::-1] + 0.5)


def _columns(grid: fusion.Grid, origin: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
  """Cells [H, W] above which the grid's surface passes at the robot's height, between voxels."""
  settings = floor_plan.FreeSpaceSettings()
  rows, columns = np.indices(shape)
  x = (origin[0] + _FINE * (columns + 0.5) - grid.lower[0]) / grid.voxel
  y = (origin[1] + _FINE * (rows + 0.5) - grid.lower[1]) / grid.voxel
  blocked = np.zeros(shape, bool)
  for level in np.arange(settings.low, settings.high, grid.voxel):
    z = np.full(shape, (level - grid.lower[2]) / grid.voxel)
    blocked |= ndimage.map_coordinates(grid.values, [x, y, z], order=1, mode="nearest") < 0
  return blocked


def _ahead(places: np.ndarray, room_from_world: Similarity) -> np.ndarray:
  """Signed distance [B'] of borders from true matter of the robot's height [m]."""
  settings = floor_plan.FreeSpaceSettings()
  levels = np.arange(settings.low, settings.high, _HEIGHTS)
  points = np.concatenate(
    [np.repeat(places, len(levels), 0), np.tile(levels, len(places))[:, None]], 1
  )
  points = room_from_world.apply(points)
  inside = (
    np.abs(points[:: len(levels), :2]) < np.array(furniture.ROOM_SIZE[:2]) / 2 + _INSIDE
  ).all(-1)
  things = [
    solid
    for solid in room.builtin().solids
    if (solids.tessellate(solid).vertices @ solid.rotation.T + solid.position)[:, 2].max()
    > settings.low
  ]
  found = solids.distance(things, points, limit=_REACH)
  found = found.reshape(len(places), len(levels)).min(1)[inside]
  return found[np.abs(found) < _REACH]


def _figures(ahead: np.ndarray) -> dict[str, harness.Value]:
  return {
    "median_m": float(np.median(ahead)),
    "mean_m": float(ahead.mean()),
    "p10_m": float(np.percentile(ahead, 10)),
    "p90_m": float(np.percentile(ahead, 90)),
    "over_tolerance": float((ahead > _TOO_DEEP).mean()),
    "places": len(ahead),
  }


def main(settings: Settings) -> None:
  """Finds the borders and prints their distances from the truth."""
  bundle = Bundle.load(settings.scene)
  room_from_world = from_plain(bundle.figures["room_from_world"], Similarity)
  lower, upper = bundle.extent
  depth = views.capture_views(
    bundle, views.renderer_of(bundle), width=SceneSettings().depth_width, count=settings.views
  )
  threshold = bundle.scene["alignment"]["floor_threshold"]
  grid = collision.solid_grid(depth, lower=lower, upper=upper, floor_threshold=threshold)
  fine = floor_plan.FreeSpaceSettings(resolution=_FINE)
  shape = tuple(np.ceil((upper[:2] - lower[:2]) / _FINE).astype(int)[::-1])
  figures: dict[str, dict[str, harness.Value]] = {}
  blocked = _columns(grid, lower[:2], (shape[0], shape[1]))
  figures["voxels"] = _figures(_ahead(_border(blocked, lower[:2], _FINE), room_from_world))
  for tolerance in settings.tolerance:
    began = time.process_time()
    chosen = decomposition.ConvexSettings(tolerance=tolerance)
    parts = decomposition.decompose(grid, settings=chosen)
    seconds = time.process_time() - began
    for name, plan in (("parts", fine), ("map", floor_plan.FreeSpaceSettings())):
      found = floor_plan.floor_plan(parts, lower=lower, upper=upper, settings=plan)
      border = _border(found.cells == 0, lower[:2], plan.resolution)
      figures[f"{name}_{1000 * tolerance:g}_mm"] = _figures(_ahead(border, room_from_world))
    free = floor_plan.floor_plan(parts, lower=lower, upper=upper, seen=grid)
    figures[f"parts_{1000 * tolerance:g}_mm"] |= {
      "parts": len(parts),
      "free_m2": free.area,
      "processor_s": seconds,
    }
    print(figures, flush=True)
  harness.finish("passages", figures, settings)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
