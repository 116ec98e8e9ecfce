"""How far two pictures with depth are from agreeing, and how that changes with what is adjusted.

Cells of one picture are laid onto the planes that the other measured in the same place, and
features that are lifted by their depth onto where the other shows them. Shapes: N pictures, H x W
cells, K rows, L numbers of the lens.

Source: point-to-plane distances, Chen and Medioni 1992, Object modelling by registration of
multiple range images; cells are paired by projection as by Newcombe et al. 2011, KinectFusion.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.core.geometry.cameras import Camera
from nerf2real.scenes.poses.depth.lens import LENS, Grid, pixels_by_lens, rays_by_lens
from nerf2real.scenes.poses.depth.matched import Matched
from nerf2real.scenes.poses.depth.surfaces import normals
from nerf2real.scenes.poses.matching.pairs import Pair

_CELLS = 400  # of a picture that are laid onto another
_FEWEST = 30  # of these that must meet a surface there
_NEAR = 0.3  # m between cells that may be one surface, chosen: places are off by less
_ALIKE = np.cos(np.radians(35.0))  # of the normals of such cells
_AHEAD = 0.2  # m before a camera that what it sees lies at least


class Rows(NamedTuple):
  """Residuals between two pictures, by how they change."""

  first: int
  second: int
  point: np.ndarray  # [K, 3] of the first, in the world [m]
  direction: np.ndarray  # [K, 3] by a shift of the point
  by_lens: np.ndarray  # [K, L]
  residual: np.ndarray  # [K]
  size: np.ndarray  # [K] in expected deviations, of both coordinates where two rows are one match
  expected: np.ndarray  # [K] deviation, up to a factor that all share


def surface_rows(
  poses: np.ndarray, camera: Camera, depth: np.ndarray, pairs: Sequence[Pair]
) -> Iterator[Rows]:
  """Yields distances [m] of pictures' cells from the planes that others measured there.

  Args:
    poses: World from camera [N, 4, 4].
    camera: Of all pictures.
    depth: Of cells [N, H, W] [m], NaN for none.
    pairs: Pictures that look at the same place.
  """
  count, height, width = depth.shape
  grid = Grid.of(camera, height, width)
  facing = [
    normals(picture, grid.rays.reshape(height, width, 3)).reshape(-1, 3) for picture in depth
  ]
  chosen = [_spread(np.flatnonzero(np.isfinite(n[:, 0]))) for n in facing]
  flat = depth.reshape(count, -1)
  points = [grid.rays[cells] * flat[k, cells, None] for k, cells in enumerate(chosen)]
  for pair in pairs:
    for i, j in (pair, pair[::-1]):
      turn = poses[j, :3, :3]
      between = turn.T @ poses[i, :3, :3]
      world = points[i] @ poses[i, :3, :3].T + poses[i, :3, 3]
      local = (world - poses[j, :3, 3]) @ turn
      at, inside = _cells_of(grid.camera, local)
      cells, world, local = chosen[i][inside], world[inside], local[inside]
      there, plane = grid.rays[at] * flat[j, at, None], facing[j][at]
      with np.errstate(invalid="ignore"):
        same = np.sum(plane * (facing[i][cells] @ between.T), axis=1) > _ALIKE
        same &= np.sum((local - there) ** 2, axis=1) < _NEAR**2
      if same.sum() < _FEWEST:
        continue
      cells, at, world, local, there, plane = (
        part[same] for part in (cells, at, world, local, there, plane)
      )
      moved = between @ (grid.by_lens[cells] * flat[i, cells, None, None])
      moved -= grid.by_lens[at] * flat[j, at, None, None]
      residual, expected = np.sum(plane * (local - there), axis=1), _noise(local[:, 2])
      yield Rows(
        i,
        j,
        world,
        plane @ turn.T,
        np.einsum("ki,kil->kl", plane, moved),
        residual,
        np.abs(residual) / expected,
        expected,
      )


def feature_rows(poses: np.ndarray, camera: Camera, matches: Sequence[Matched]) -> Iterator[Rows]:
  """Yields distances [pixel] of lifted features from where other pictures show them.

  Args:
    poses: World from camera [N, 4, 4].
    camera: Of all pictures.
    matches: Features that pictures share.
  """
  if not matches:
    return
  counts = [len(match.depth) for match in matches]
  pixel, depth, seen = (
    np.concatenate([getattr(match, name) for match in matches])
    for name in ("pixel", "depth", "seen")
  )
  rays, by_lens = camera.rays(pixel), rays_by_lens(camera, pixel)
  start = 0
  for match, count in zip(matches, counts, strict=True):
    i, j, rows = match.first, match.second, slice(start, start + count)
    start += count
    turn = poses[j, :3, :3]
    lifted = rays[rows] * depth[rows, None]
    world = lifted @ poses[i, :3, :3].T + poses[i, :3, 3]
    local = (world - poses[j, :3, 3]) @ turn
    ahead = local[:, 2] > _AHEAD
    if not ahead.any():
      continue
    world, local = world[ahead], local[ahead]
    residual = camera.project(local) - seen[rows][ahead]
    x, y, z = local.T
    by_point = np.zeros((len(local), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    moved = by_lens[rows][ahead] * depth[rows][ahead, None, None]
    moved = by_point @ (turn.T @ poses[i, :3, :3]) @ moved + pixels_by_lens(camera, local)
    yield Rows(
      i,
      j,
      np.repeat(world, 2, axis=0),
      (by_point @ turn.T).reshape(-1, 3),
      moved.reshape(-1, len(LENS)),
      residual.ravel(),
      np.repeat(np.linalg.norm(residual, axis=1), 2),
      np.ones(residual.size),
    )


def _spread(found: np.ndarray) -> np.ndarray:
  """Returns `_CELLS` of indices at most, evenly."""
  return found[:: max(1, len(found) // _CELLS)]


def _cells_of(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the flat cells that points [K, 3] lie in, and which of them are seen, bool [K]."""
  seen = points[:, 2] > _AHEAD
  pixel = np.full((len(points), 2), -1.0)
  pixel[seen] = camera.project(points[seen])
  column, row = np.floor(pixel).astype(int).T
  seen &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
  return row[seen] * camera.width + column[seen], seen


def _noise(depth: np.ndarray) -> np.ndarray:
  """Returns how much [m] depth [m] scatters, up to a factor.

  Source: Khoshelham and Elberink 2012, Accuracy and resolution of Kinect depth data: 1.4 mm at 1 m,
  growing with the square; near by, a grid's cells are what limits.
  """
  return 1e-3 * (1.0 + 1.4 * depth**2)
