"""Pairs that contradict the rotations on which most of the matched area agrees."""

import itertools

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from nerf2real.scenes.poses.checks import rotations

COUNT, NOISE = 14, np.radians(1.0)


def _ring(wrong, *, seed=0):
  """A walk around a room: neighbours match, and the pictures of `wrong` a thing alike elsewhere.

  Returns:
    Pairs, and the true rotations [N, 3, 3]. Pictures of a false pair are turned by 80 degrees.
  """
  random = np.random.default_rng(seed)
  truth = Rotation.random(COUNT, rng=random)
  first, second, turns, areas = [], [], [], []
  for one, other in itertools.combinations(range(COUNT), 2):
    apart = min(other - one, COUNT - other + one)
    false = (one in wrong) != (other in wrong) and apart > 3
    if apart > 3 and not false:
      continue
    turn = Rotation.from_rotvec(NOISE * random.standard_normal(3)) * truth[other] * truth[one].inv()
    if false:  # the alike thing stands elsewhere, always by the same turn
      elsewhere = Rotation.from_euler("y", 80 if one in wrong else -80, degrees=True)
      turn = truth[other] * elsewhere * truth[one].inv()
    first.append(one)
    second.append(other)
    turns.append(turn.as_matrix())
    areas.append(12.0 if false else 40.0 - 8.0 * apart)
  pairs = rotations.Pairs(list(range(1, COUNT + 1)), *map(np.array, (first, second, turns, areas)))
  return pairs, truth.as_matrix()


def _model(cam_from_world):
  """A model of pictures with these rotations [N, 3, 3]."""
  model = pycolmap.Reconstruction()
  camera = pycolmap.Camera(
    camera_id=1, model="SIMPLE_PINHOLE", width=640, height=480, params=[500.0, 320.0, 240.0]
  )
  model.add_camera_with_trivial_rig(camera)
  for number, turn in enumerate(cam_from_world):
    image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number + 1)
    model.add_image_with_trivial_frame(
      image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.ones(3))
    )
  return model


@pytest.mark.parametrize("wrong", [(), (4, 5, 6)])
def test_what_most_area_agrees_with_is_found_whatever_is_alike(wrong):
  pairs, truth = _ring(wrong)
  found = rotations.consensus(pairs)
  frames = np.swapaxes(found, -1, -2) @ truth
  assert rotations.angles(frames[0].T @ frames).max() < 5 * NOISE
  false = rotations.errors(pairs, truth) > 0.5
  assert false.any() == bool(wrong)
  assert (rotations.errors(pairs, found) > 0.5).tolist() == false.tolist()


def test_a_model_built_on_things_alike_is_contradicted_and_a_right_one_is_not():
  wrong = (4, 5, 6)
  pairs, truth = _ring(wrong)
  found = rotations.consensus(pairs)
  assert rotations.contradiction(_model(truth), pairs, found) is None
  turned = truth.copy()
  turned[list(wrong)] = truth[list(wrong)] @ Rotation.from_euler("y", -80, degrees=True).as_matrix()
  said = rotations.contradiction(_model(turned), pairs, found)
  assert said.turned == ["4.png", "5.png", "6.png"]
  false = np.flatnonzero(rotations.errors(pairs, truth) > 0.5)
  assert said.refuted == {(pairs.first[n] + 1, pairs.second[n] + 1) for n in false}


def test_pictures_without_pairs_stand_anyhow():
  none = rotations.Pairs([1, 2], *np.zeros((2, 0), int), np.zeros((0, 3, 3)), np.zeros(0))
  found = rotations.consensus(none)
  assert found == pytest.approx(np.tile(np.eye(3), (2, 1, 1)))
  model = _model(Rotation.random(2, rng=1).as_matrix())
  assert rotations.contradiction(model, none, found) is None
