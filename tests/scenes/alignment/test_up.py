"""Cameras show up as surely as they look to different sides and are held alike."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry import rotations
from nerf2real.scenes.alignment import up
from nerf2real.scenes.alignment.planes import across

UP = np.array([0.0, 0.0, 1.0])


def held(rng, headings, *, pitch=0.0, roll=0.0, spread=2.0):
  """Poses [N, 4, 4] of cameras that look along headings, pitch and roll by angles [degree]."""
  poses = np.tile(np.eye(4), (len(headings), 1, 1))
  for pose, heading in zip(poses, headings, strict=True):
    down = np.radians(rng.normal(pitch, 2 * spread))
    level = np.cos(down)
    forward = np.array([level * np.cos(heading), level * np.sin(heading), np.sin(down)])
    turn = Rotation.from_rotvec([0, 0, np.radians(rng.normal(roll, spread))]).as_matrix()
    pose[:3, :3] = rotations.camera_axes(forward) @ turn
  return poses


def around(count):
  return np.linspace(0, 2 * np.pi, count, endpoint=False)


def widest(belief):
  """Standard deviation to the side to which up is least sure [rad]."""
  plane = across(belief.direction)
  return np.linalg.eigvalsh(plane @ belief.precision @ plane.T)[0] ** -0.5


def widest_deg(poses):
  return np.degrees(widest(up.up_of_cameras(poses)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
  "headings,how",
  [
    (around(40), {}),
    (around(40), {"roll": 8.0}),
    (around(40), {"pitch": -35.0}),
    (np.linspace(0, np.pi, 40), {"pitch": -35.0}),
    (np.linspace(-0.2, 0.2, 11), {"roll": 8.0}),
    (np.linspace(-0.5, 0.5, 11), {"pitch": -35.0}),
    (np.linspace(-0.3, 0.3, 3), {"roll": 5.0, "pitch": -20.0}),
  ],
)
def test_true_up_is_within_what_cameras_leave_open(seed, headings, how):
  belief = up.up_of_cameras(held(np.random.default_rng(seed), headings, **how))
  assert belief.deviations(UP) < 3
  assert belief.density(UP) > 0.01


def test_up_is_surer_of_cameras_that_look_to_all_sides_and_of_many():
  rng = np.random.default_rng(0)
  room, facade = (
    widest_deg(held(rng, around(40))),
    widest_deg(held(rng, np.linspace(-0.2, 0.2, 40))),
  )
  assert room < 2 and 4 < facade < 10
  assert room < widest_deg(held(rng, around(5))) < 5
  assert room < widest_deg(held(rng, around(40), spread=6.0))
  assert widest_deg(held(rng, np.zeros(1))) > 20  # of one, its pitch is unknown


def test_a_film_is_worth_fewer_pictures_than_it_has():
  rng = np.random.default_rng(0)
  apart = held(rng, around(40))
  film = held(rng, np.repeat(around(40), 5))
  for k in range(0, len(film), 5):  # held still for five pictures
    film[k : k + 5] = film[k]
  assert widest_deg(film) > 0.7 * widest_deg(apart)


def test_turned_pictures_count_by_the_axis_that_is_level():
  rng = np.random.default_rng(0)
  poses = held(rng, around(40))
  turned = poses.copy()
  turned[::2, :3, :3] = poses[::2, :3, :3] @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
  expected, found = up.up_of_cameras(poses, UP), up.up_of_cameras(turned, UP)
  np.testing.assert_allclose(found.precision, expected.precision, rtol=1e-9)


def test_density_falls_with_deviations_to_the_side():
  belief = up.UpBelief(UP, np.diag([1.0, 100.0, 0.0]), 8.0)
  tilted = np.array([[np.sin(0.1), 0, np.cos(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
  np.testing.assert_allclose(belief.deviations(tilted), [0.1, 1.0], rtol=1e-9)
  np.testing.assert_allclose(belief.density(tilted[1]), (9 / 8) ** -5.0)
  assert widest(belief) == pytest.approx(1.0)
  assert belief.density(UP) == 1


def test_cameras_rolled_all_ways_are_refused():
  rolled = np.tile(np.eye(4), (2, 1, 1))
  rolled[1, :2, :2] *= -1
  with pytest.raises(ValueError, match="override"):
    up.up_of_cameras(rolled)
