"""What pictures ought to see of what others see."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.checks import overlap
from nerf2real.scenes.poses.mapping import registered
from tests.scenes.poses.checks import alike_things

SIDE = np.linspace(-0.9, 0.9, 25)
WALL = np.stack([*np.meshgrid(SIDE, SIDE), np.full((25, 25), 4.0)], -1).reshape(-1, 3)


def _model(positions, points, seen):
  """Pictures at positions [N, 3] that look along z and see points [P, 3]: bool [N, P].

  Of them those that lie in the picture.
  """
  model = pycolmap.Reconstruction()
  camera = pycolmap.Camera(
    camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[640.0, 320.0, 240.0]
  )
  model.add_camera_with_trivial_rig(camera)
  seen = seen.copy()
  for number, position in enumerate(positions):
    pixels = camera.img_from_cam(points - position)
    seen[number] &= ((pixels > 0) & (pixels < [640, 480])).all(1)
    image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number + 1)
    image.points2D = [pycolmap.Point2D(xy) for xy in pixels[seen[number]]]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), -np.array(position))
    model.add_image_with_trivial_frame(image, pose)
  order = np.cumsum(seen, axis=1) - 1
  for column, xyz in enumerate(points):
    elements = [
      pycolmap.TrackElement(row + 1, int(order[row, column]))
      for row in np.flatnonzero(seen[:, column])
    ]
    model.add_point3D(xyz, pycolmap.Track(elements=elements))
  return model


def _between(model):
  """Cells that the first two pictures have in common, and that are missing."""
  found = overlap.overlap(model)
  assert found.common == pytest.approx(found.common.T)
  return found.common[0, 1], found.missing[0, 1]


def _two(position, both):
  """Two pictures of the wall, the second at a position; they have some of its points in common."""
  points = np.concatenate([WALL, WALL + 1e-3])
  seen = np.repeat([[True, False], [False, True]], len(WALL), axis=1)
  seen[1, : len(WALL)] = both
  return _model([np.zeros(3), np.array(position)], points, seen)


def test_pictures_of_one_place_have_most_of_it_in_common():
  common, missing = _between(_two([0.2, 0, 0], np.ones(len(WALL), bool)))
  assert common > 60 and missing <= 0.2 * common


def test_what_neither_finds_of_the_other_is_missing():
  common, missing = _between(_two([0.2, 0, 0], np.zeros(len(WALL), bool)))
  assert common == 0 and missing > 60
  half = WALL[:, 0] < 0
  common, missing = _between(_two([0.2, 0, 0], half))
  assert common > 25 and missing > 25


@pytest.mark.parametrize(
  "position",
  [
    [3.0, 0, 0],  # from another side
    [0, 0, 2.0],  # from twice as near
  ],
)
def test_pictures_from_elsewhere_need_not_find_the_same(position):
  assert _between(_two(position, np.zeros(len(WALL), bool))) == (0, 0)


def test_a_cell_counts_by_those_that_ought_to_see_it():
  seen = np.ones((3, len(WALL)), bool)
  positions = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]])
  whole = overlap.overlap(_model(positions, WALL, seen)).balance
  seen[2] = False
  points = np.concatenate([WALL, WALL + 1e-3])
  other = np.repeat([[False], [False], [True]], len(WALL), axis=1)
  alone = overlap.overlap(_model(positions, points, np.concatenate([seen, other], 1))).balance
  cells = whole / 3  # of each picture's all are seen by all others
  # the first two: one of two others sees a cell; the third: none does
  assert alone == pytest.approx(2 * 0 * cells - cells, abs=0.15 * cells)


def test_what_is_hidden_need_not_be_found():
  position = np.array([1.2, 0, 0])
  screen = position + WALL * [0.5, 0.5, 0.125]  # fills the second picture, and is not in the first
  points = np.concatenate([WALL, screen])
  seen = np.repeat([[True, False], [False, True]], len(WALL), axis=1)
  assert _between(_model([np.zeros(3), position], points, seen)) == (0, 0)
  behind = np.concatenate([WALL, WALL - [1e-3, 0, 0]])  # without it the wall ought to be seen
  assert _between(_model([np.zeros(3), position], behind, seen))[1] > 10


def test_right_places_see_more_of_what_they_ought_to(alike_matched):
  truth, database = alike_matched
  right = overlap.overlap(truth)
  assert right.ids == [image.image_id for image in registered(truth)]
  balances = [right.balance]
  wrong = pycolmap.Reconstruction(truth)
  for row in range(6):  # in the end all stand before one thing, and pairs have most in common
    alike_things.mistake(wrong, database, registered(wrong)[row])
    balances.append(overlap.overlap(wrong).balance)
  assert (np.array(balances[2:]) < 0.9 * right.balance).all() and balances[-1] < 0.7 * right.balance
  assert overlap.overlap(wrong).common.sum() > 1.5 * right.common.sum()


def _torn(model):
  """The model in two halves: what both see is points of each half's own."""
  torn = pycolmap.Reconstruction(model)
  half = {image for image in torn.images if image <= len(torn.images) // 2}
  for number, point in list(torn.points3D.items()):
    seen = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in half]
    if 2 <= len(seen) <= len(point.track.elements) - 2:
      for image, feature in seen:
        torn.delete_observation(image, feature)
      track = pycolmap.Track(elements=[pycolmap.TrackElement(*place) for place in seen])
      torn.add_point3D(point.xyz, track, point.color)
      assert number in torn.points3D
  return torn


def test_a_model_in_two_halves_lacks_what_they_have_in_common(folder):
  whole = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  torn = _torn(whole)
  assert torn.num_reg_images() == whole.num_reg_images()
  assert torn.compute_num_observations() == whole.compute_num_observations()
  assert overlap.overlap(torn).balance < 0.9 * overlap.overlap(whole).balance


def test_a_model_without_points_has_nothing_in_common():
  model = _model(np.zeros((2, 3)), np.zeros((0, 3)), np.zeros((2, 0), bool))
  found = overlap.overlap(model)
  assert found.balance == 0 and found.common.shape == (2, 2)
