"""Poses and lens found by the surfaces and the features that pictures with depth share."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry.cameras import Camera
from nerf2real.core.geometry.similarity import Similarity
from nerf2real.scenes.poses.depth import adjustment, lens, residuals
from nerf2real.scenes.poses.depth.matched import Matched
from tests.scenes import furnished_room

_CAMERA = Camera(width=160, height=120, fx=131.0, fy=132.0, cx=81.0, cy=59.0, k1=0.05, k2=-0.06)
_COUNT = 24
_PAIRS = [(i, j) for i in range(_COUNT) for j in range(max(0, i - 8), i)]


def _look_about():
  """Poses [24, 4, 4] of a walk past the furniture."""
  poses = []
  for angle in np.linspace(0.0, 2.4, _COUNT):
    place = [0.6 * np.cos(angle) - 0.2, 0.5 * np.sin(angle) - 0.3, 1.2 + 0.2 * np.sin(3 * angle)]
    poses.append(
      furnished_room.look_at(place, [2.0 * np.cos(angle + 0.4), 2.0 * np.sin(angle + 0.4), 0.6])
    )
  return np.array(poses)


_POSES = _look_about()


@pytest.fixture(scope="module")
def depth():
  """z-depth [24, 120, 160] [m] with as much noise as a cell of 16 pixels has, NaN for none."""
  rng = np.random.default_rng(2)
  views = furnished_room.depth_views(_POSES, _CAMERA, noise=0.0005, rng=rng)
  return np.where(np.isfinite(views.depth), views.depth, np.nan)


def _matches(depth, *, every=37, noise=0.3):
  """Cells of pictures and where others see them, less those that something hides."""
  rng, rays, found = np.random.default_rng(3), _CAMERA.rays(), []
  for i, j in [*_PAIRS, *[pair[::-1] for pair in _PAIRS]]:
    row, column = (axis.ravel()[::every] for axis in np.mgrid[5:115, 5:155])
    at = depth[i, row, column]
    world = (rays[row, column] * at[:, None]) @ _POSES[i, :3, :3].T + _POSES[i, :3, 3]
    local = (world - _POSES[j, :3, 3]) @ _POSES[j, :3, :3]
    cell, seen = residuals._cells_of(_CAMERA, local)
    seen[seen] = np.abs(depth[j].ravel()[cell] - local[seen, 2]) < 0.03
    if seen.any():
      pixel = np.column_stack([column, row])[seen] + 0.5
      there = _CAMERA.project(local[seen]) + noise * rng.standard_normal((seen.sum(), 2))
      found.append(Matched(i, j, pixel, at[seen], there))
  return found


def _tracked(seed=0, position=0.01, degrees=0.5):
  """Poses as a tracker errs."""
  rng, poses = np.random.default_rng(seed), _POSES.copy()
  poses[:, :3, 3] += position * rng.standard_normal((len(poses), 3))
  turns = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((len(poses), 3)))
  poses[:, :3, :3] = turns.as_matrix() @ poses[:, :3, :3]
  return poses


def _errors(poses):
  """Distances [N] [m] and turns [N] [rad] from the true poses, in the frame that fits best."""
  back = Similarity.fit(poses[:, :3, 3], _POSES[:, :3, 3], with_scale=False)
  moved = back.apply_pose(poses)
  turns = Rotation.from_matrix(np.swapaxes(moved[:, :3, :3], 1, 2) @ _POSES[:, :3, :3])
  return np.linalg.norm(moved[:, :3, 3] - _POSES[:, :3, 3], axis=1), turns.magnitude()


def test_a_trackers_errors_are_taken_out(depth):
  came = _tracked()
  poses, camera = adjustment.adjust(came, _CAMERA, depth, _matches(depth), _PAIRS, came=came)
  before, after = _errors(came), _errors(poses)
  assert np.median(before[0]) > 0.01
  assert np.median(after[0]) < 0.002
  assert np.median(after[1]) < np.radians(0.1)
  assert camera.fx == pytest.approx(_CAMERA.fx, rel=0.002)


def test_surfaces_alone_turn_pictures_rightly(depth):
  """Some see one wall and slide along it."""
  came = _tracked()
  poses, _ = adjustment.adjust(came, _CAMERA, depth, [], _PAIRS, came=came)
  assert np.median(_turned_apart(came)) > np.radians(0.5)
  assert np.median(_turned_apart(poses)) < np.radians(0.05)


def _turned_apart(poses):
  """How far [rad] pictures are turned against the first, less what they truly are."""
  turns, true = (p[0, :3, :3].T @ p[1:, :3, :3] for p in (poses, _POSES))
  return Rotation.from_matrix(np.swapaxes(turns, 1, 2) @ true).magnitude()


def test_a_lens_that_is_nominal_is_found_too(depth):
  nominal = Camera(width=160, height=120, fx=134.0, fy=134.0, cx=80.0, cy=60.0)
  came = _tracked()
  poses, camera = adjustment.adjust(came, nominal, depth, _matches(depth), _PAIRS, came=came)
  assert np.median(_errors(poses)[0]) < 0.003
  for name in ("fx", "fy", "cx", "cy"):
    assert getattr(camera, name) == pytest.approx(getattr(_CAMERA, name), abs=0.4)
  away = np.abs(camera.rays() - _CAMERA.rays())
  assert away.max() < 0.01 < np.abs(nominal.rays() - _CAMERA.rays()).max()


def test_what_sees_nothing_stays_where_it_came(depth):
  blind = depth.copy()
  blind[5] = np.nan
  matches = [m for m in _matches(depth) if 5 not in (m.first, m.second)]
  came = _tracked()
  poses, _ = adjustment.adjust(came, _CAMERA, blind, matches, _PAIRS, came=came)
  np.testing.assert_allclose(poses[5], came[5], atol=1e-9)
  assert np.median(_errors(poses)[0]) < 0.003


@pytest.mark.parametrize("kind", ["surfaces", "features"])
def test_residuals_change_as_they_say(depth, kind):
  """Against finite differences: planes and their cells kept, a pose or the lens moved."""
  came = _tracked()

  def rows(poses, camera):
    if kind == "features":
      return list(residuals.feature_rows(poses, camera, _matches(depth)[3:4]))
    return list(residuals.surface_rows(poses, camera, depth, [(6, 4)]))[:1]

  (before,) = rows(came, _CAMERA)
  by_pose = np.hstack([np.cross(before.point, before.direction), before.direction])
  step, compared = 1e-6, 0
  for at, sign in ((before.first, 1.0), (before.second, -1.0)):
    for axis in range(6):
      moved, twist = came.copy(), np.zeros(6)
      twist[axis] = step
      turn = Rotation.from_rotvec(twist[:3]).as_matrix()
      moved[at, :3, :3] = turn @ moved[at, :3, :3]
      moved[at, :3, 3] = turn @ moved[at, :3, 3] + twist[3:]
      (after,) = rows(moved, _CAMERA)
      if len(after.residual) == len(before.residual):
        compared += 1
        slope = (after.residual - before.residual) / step
        # a plane turns with its camera: by as much as the residual times the turn
        assert np.median(np.abs(slope - sign * by_pose[:, axis])) < 0.03 * np.abs(by_pose).max()
  for axis, size in enumerate(lens._STEPS):
    change = np.zeros(len(lens.LENS))
    change[axis] = 1e-3 * size
    (after,) = rows(came, lens.with_lens(_CAMERA, change))
    if len(after.residual) == len(before.residual):
      compared += 1
      slope = (after.residual - before.residual) / change[axis]
      expected = before.by_lens[:, axis]
      assert np.median(np.abs(slope - expected)) < 0.05 * np.abs(expected).max() + 1e-4
  assert compared > 12  # of 20: at others a cell meets no surface any more


def test_poses_that_came_hold_what_slides(depth):
  """Before one wall and nothing else a picture may slide along it."""
  wall = np.full((24, 12, 16), 2.0, np.float32)
  poses = np.tile(np.eye(4), (24, 1, 1))
  poses[:, 0, 3] = 0.01 * np.arange(24)
  came = poses.copy()
  came[:, 2, 3] += 0.01 * np.random.default_rng(1).standard_normal(24)
  camera = Camera(width=16, height=12, fx=14.0, fy=14.0, cx=8.0, cy=6.0)
  found, seen = adjustment.adjust(came, camera, wall, [], _PAIRS, came=came)
  assert np.ptp(found[:, 2, 3]) < 0.002 < 0.02 < np.ptp(came[:, 2, 3])
  np.testing.assert_allclose(found[:, 0, 3], poses[:, 0, 3], atol=0.002)
  assert dataclasses.astuple(seen) == pytest.approx(dataclasses.astuple(camera), abs=0.05)
