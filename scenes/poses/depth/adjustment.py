"""Adjusts all poses and the lens to the surfaces and the features that pictures with depth share.

A feature tells where a picture looks, and a plain wall has few; its depth tells how far the wall is
and how it stands, in every picture. So each picture's cells are laid onto the planes that its
neighbours measured in the same place, and features that are lifted by their depth onto where their
neighbours show them. One Gauss-Newton step after the other moves all poses and the lens at once.
The poses that came hold, lightly, what neither shows. Shapes: N pictures, H x W cells, K rows of
residuals, L numbers of the lens.

Source: point-to-plane distances, Chen and Medioni 1992, Object modelling by registration of
multiple range images; cells are paired by projection as by Newcombe et al. 2011, KinectFusion.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.cameras import Camera
from nerf2real.core.least_squares import cauchy_weights
from nerf2real.core.progress import Progress, no_progress
from nerf2real.scenes.poses.depth.matched import Matched
from nerf2real.scenes.poses.depth.surfaces import (
  LENS,
  Grid,
  normals,
  pixels_by_lens,
  rays_by_lens,
  with_lens,
)
from nerf2real.scenes.poses.matching.pairs import Pair

_ROUNDS = 10  # at most
_SETTLED = 2e-4  # m, root mean square, that places move by in a round that is the last
_CELLS = 400  # of a picture that are laid onto another
_FEWEST = 30  # of these that must meet a surface there
_NEAR = 0.3  # m between cells that may be one surface, chosen: places are off by less
_ALIKE = np.cos(np.radians(35.0))  # of the normals of such cells
_AHEAD = 0.2  # m before a camera that what it sees lies at least
_MEDIAN = 0.6745  # of the size of a normal variable, in standard deviations
_MEDIAN_2D = 1.1774  # of the length of two of them
_WIDE = 2.0  # deviations from which a residual counts less
_WORTH = (
  60,
  100,
)  # observations that a pair's cells and matches count as at most: errors go together
_FIRST = 0.1  # m and rad that poses which came may be off before any is known better
_LIGHTLY = 3.0  # times what they are found to be off: errors of pictures near each other are alike
_EXACT = 1e-4  # m and rad that they are off at least
_LENS = (
  0.02,
  0.02,
  0.02,
  0.02,
  0.1,
  0.1,
  0.01,
  0.01,
)  # deviations, the first four of focal lengths


class _Rows(NamedTuple):
  """Residuals between two pictures, by how they change."""

  first: int
  second: int
  point: np.ndarray  # [K, 3] of the first, in the world [m]
  direction: np.ndarray  # [K, 3] by a shift of the point
  by_lens: np.ndarray  # [K, L]
  residual: np.ndarray  # [K]
  size: np.ndarray  # [K] in expected deviations, of both coordinates where two rows are one match
  expected: np.ndarray  # [K] deviation, up to a factor that all share


def adjust(
  poses: np.ndarray,
  camera: Camera,
  depth: np.ndarray,
  matches: Sequence[Matched],
  pairs: Sequence[Pair],
  *,
  came: np.ndarray,
  report: Progress = no_progress,
) -> tuple[np.ndarray, Camera]:
  """Returns the poses [N, 4, 4] and the camera under which surfaces and features agree best.

  Args:
    poses: World from camera [N, 4, 4] to begin with, metric.
    camera: Of the pictures.
    depth: Of cells [N, H, W] [m], NaN for none.
    matches: Features that pictures share.
    pairs: Pictures that look at the same place.
    came: Poses [N, 4, 4] as they came with the pictures.
    report: Called with the fraction done and a text.
  """
  poses, nominal, allowed = poses.copy(), camera, (_FIRST, _FIRST)
  for number in range(_ROUNDS):
    report(number / _ROUNDS, f"laying {len(poses)} pictures' surfaces onto each other")
    system = _System(len(poses))
    for kind, worth, median in (
      (list(_surfaces(poses, camera, depth, pairs)), _WORTH[0], _MEDIAN),
      (list(_features(poses, camera, matches)), _WORTH[1], _MEDIAN_2D),
    ):
      if kind:
        spread = float(np.median(np.concatenate([rows.size for rows in kind]))) / median
        for rows in kind:
          system.add(rows, max(spread, _EXACT), worth)
    system.hold(poses, came, allowed)
    system.hold_lens(camera, nominal)
    turns, shifts, lens = system.step()
    before = poses[:, :3, 3].copy()
    poses[:, :3, 3] = np.einsum("nij,nj->ni", turns, before) + shifts
    poses[:, :3, :3] = turns @ poses[:, :3, :3]
    camera = with_lens(camera, lens)
    allowed = _allowed(poses[:, :3, 3] - came[:, :3, 3]), _allowed(_turns(poses, came))
    if np.sqrt(np.mean((poses[:, :3, 3] - before) ** 2)) < _SETTLED:
      break
  return poses, camera


def _surfaces(
  poses: np.ndarray, camera: Camera, depth: np.ndarray, pairs: Sequence[Pair]
) -> Iterator[_Rows]:
  """Yields distances of pictures' cells from the planes that others measured there."""
  _, height, width = depth.shape
  grid = Grid.of(camera, height, width)
  facing = [normals(picture, grid.rays) for picture in depth]
  chosen = [_spread(np.flatnonzero(np.isfinite(n[..., 0]))) for n in facing]
  rays, by_lens = grid.rays.reshape(-1, 3), grid.by_lens.reshape(-1, 3, len(LENS))
  flat = depth.reshape(len(depth), -1)
  for pair in pairs:
    for i, j in (pair, pair[::-1]):
      cell, turn = chosen[i], poses[j, :3, :3]
      world = (rays[cell] * flat[i, cell, None]) @ poses[i, :3, :3].T + poses[i, :3, 3]
      local = (world - poses[j, :3, 3]) @ turn
      at, inside = _cells_of(grid.camera, local)
      cell, world, local = cell[inside], world[inside], local[inside]
      plane = facing[j].reshape(-1, 3)[at]
      there = rays[at] * flat[j, at, None]
      own = facing[i].reshape(-1, 3)[cell] @ poses[i, :3, :3].T @ turn
      with np.errstate(invalid="ignore"):
        same = np.sum(plane * own, axis=1) > _ALIKE
        same &= np.sum((local - there) ** 2, axis=1) < _NEAR**2
      if same.sum() < _FEWEST:
        continue
      cell, at, world, local, plane = (part[same] for part in (cell, at, world, local, plane))
      moved = by_lens[cell] * flat[i, cell, None, None]
      moved = np.einsum("ij,kjl->kil", turn.T @ poses[i, :3, :3], moved)
      moved -= by_lens[at] * flat[j, at, None, None]
      residual = np.sum(plane * (local - there[same]), axis=1)
      expected = _noise(local[:, 2])
      yield _Rows(
        i,
        j,
        world,
        plane @ turn.T,
        np.einsum("ki,kil->kl", plane, moved),
        residual,
        np.abs(residual) / expected,
        expected,
      )


def _features(poses: np.ndarray, camera: Camera, matches: Sequence[Matched]) -> Iterator[_Rows]:
  """Yields distances [pixel] of lifted features from where other pictures show them."""
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
    yield _Rows(
      i,
      j,
      np.repeat(world, 2, axis=0),
      (by_point @ turn.T).reshape(-1, 3),
      moved.reshape(-1, len(LENS)),
      residual.ravel(),
      np.repeat(np.linalg.norm(residual, axis=1), 2),
      np.ones(residual.size),
    )


class _System:
  """Normal equations of small turns about the world's origin, shifts, and the lens."""

  def __init__(self, count: int):
    self._count = count
    self._blocks = np.zeros((count, count, 6, 6))
    self._slope = np.zeros((count, 6))
    self._beside = np.zeros((count, 6, len(LENS)))
    self._lens = np.zeros((len(LENS), len(LENS)))
    self._lens_slope = np.zeros(len(LENS))

  def add(self, rows: _Rows, spread: float, worth: float) -> None:
    """Adds residuals with the Cauchy loss; those of a pair are worth so many at most."""
    by_pose = np.hstack([np.cross(rows.point, rows.direction), rows.direction])
    root = cauchy_weights(rows.size, _WIDE * spread) / (spread * rows.expected)
    root = root * np.sqrt(min(1.0, worth / len(root)))
    moving, lens, residual = (
      by_pose * root[:, None],
      rows.by_lens * root[:, None],
      rows.residual * root,
    )
    square, slope, beside = moving.T @ moving, moving.T @ residual, moving.T @ lens
    i, j = rows.first, rows.second
    self._blocks[i, i] += square
    self._blocks[j, j] += square
    self._blocks[i, j] -= square
    self._blocks[j, i] -= square
    self._slope[i] += slope
    self._slope[j] -= slope
    self._beside[i] += beside
    self._beside[j] -= beside
    self._lens += lens.T @ lens
    self._lens_slope += lens.T @ residual

  def hold(self, poses: np.ndarray, came: np.ndarray, allowed: tuple[float, ...]) -> None:
    """Holds poses at those that came, which are off by so much [m] and [rad]."""
    shift, turn = allowed
    off = np.hstack([_turns(poses, came) / turn, (poses[:, :3, 3] - came[:, :3, 3]) / shift])
    for row, place in enumerate(poses[:, :3, 3]):
      by_pose = np.zeros((6, 6))
      by_pose[:3, :3] = np.eye(3) / turn
      by_pose[3:, :3] = -_cross_matrix(place) / shift
      by_pose[3:, 3:] = np.eye(3) / shift
      self._blocks[row, row] += by_pose.T @ by_pose
      self._slope[row] += by_pose.T @ off[row]

  def hold_lens(self, camera: Camera, nominal: Camera) -> None:
    """Holds the lens at what it began with."""
    size = np.array([nominal.fx, nominal.fy, nominal.fx, nominal.fy, 1.0, 1.0, 1.0, 1.0])
    off = np.array([getattr(camera, name) - getattr(nominal, name) for name in LENS])
    weight = (size * _LENS) ** -2.0
    self._lens += np.diag(weight)
    self._lens_slope += weight * off

  def step(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns turns [N, 3, 3], shifts [N, 3] [m] and the lens' change [L]."""
    size = 6 * self._count
    whole = np.empty((size + len(LENS), size + len(LENS)))
    whole[:size, :size] = self._blocks.transpose(0, 2, 1, 3).reshape(size, size)
    whole[:size, size:] = self._beside.reshape(size, -1)
    whole[size:, :size] = whole[:size, size:].T
    whole[size:, size:] = self._lens
    moved = -np.linalg.solve(whole, np.concatenate([self._slope.ravel(), self._lens_slope]))
    poses = moved[:size].reshape(-1, 6)
    return Rotation.from_rotvec(poses[:, :3]).as_matrix(), poses[:, 3:], moved[size:]


def _allowed(off: np.ndarray) -> float:
  """Returns the deviation that poses may have, of what they are off [N, 3] those that came."""
  return _LIGHTLY * max(float(np.median(np.abs(off))) / _MEDIAN, _EXACT)


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


def _turns(poses: np.ndarray, other: np.ndarray) -> np.ndarray:
  """Returns rotation vectors [N, 3] from other poses to these."""
  return Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(other[:, :3, :3], 1, 2)).as_rotvec()


def _cross_matrix(vector: np.ndarray) -> np.ndarray:
  x, y, z = vector
  return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
