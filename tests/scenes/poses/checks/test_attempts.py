"""Of several models of the same matches the one is taken that is worth most."""

from typing import NamedTuple

import numpy as np
import pytest

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses import mapping
from nerf2real.scenes.poses.checks import attempts


class Attempt(NamedTuple):
  """What stands for a model."""

  number: int
  pictures: int = 10

  def num_reg_images(self):
    return self.pictures


@pytest.mark.parametrize(
  ("balances", "places", "taken", "unsure"),
  [
    ((0.83, 0.87, 0.86), (0.0, 0.2, 0.5), 1, 0.2),  # all differ: the best
    ((0.87, 0.86), (0.0, 0.01), 0, 0.01),  # two are the same: no third
    ((0.83, 0.86, 0.87), (0.2, 0.0, 0.01), 2, 0.01),
    ((0.87, 0.83, 0.84), (0.0, 0.2, 0.21), 0, 0.2),  # two are, and another is better
    ((0.87, 0.5, 0.6), (0.0, 0.2, 0.5), 0, 0.0),  # what sees clearly less says nothing of the best
    ((0.87, 0.5, 0.86), (0.0, 0.2, 0.5), 0, 0.5),
    ((-0.87, -0.86, -2.0), (0.0, 0.2, 0.5), 1, 0.2),  # of blurred pictures most may lack
    ((None, 0.5, None), (None, 0.0, None), 1, 0.0),  # an attempt that found nothing
    ((None, None, None), (None, None, None), None, 0.0),
  ],
)
def test_attempts_end_with_two_that_are_the_same(monkeypatch, balances, places, taken, unsure):
  tried = []
  monkeypatch.setattr(
    attempts, "apart", lambda one, two: abs(places[one.number] - places[two.number])
  )

  def attempt(number):
    tried.append(number)
    return None if balances[number] is None else Attempt(number)

  best, apart = attempts.best_of(attempt, lambda m: balances[m.number], attempts=3, same=0.05)
  assert (best and best.number) == taken and apart == pytest.approx(unsure)
  assert tried == list(range(len(balances)))


def test_one_attempt_is_not_judged():
  def never(model):
    raise AssertionError(model)

  found, apart = attempts.best_of(Attempt, never, attempts=1, same=0.05)
  assert found.number == 0 and apart == 0.0


def test_all_attempts_may_be_rivals(monkeypatch):
  monkeypatch.setattr(attempts, "apart", lambda one, two: 0.1 * abs(one.number - two.number))
  worths = (-5.0, -90.0, -200.0)
  for clear, unsure in ((0.1, 0.0), (np.inf, 0.1)):
    found, apart = attempts.best_of(
      Attempt, lambda m: worths[m.number], attempts=3, same=0.05, clear=clear
    )
    assert found.number == 0 and apart == pytest.approx(unsure)


def test_an_attempt_that_places_few_pictures_is_not_taken(monkeypatch):
  monkeypatch.setattr(attempts, "apart", lambda one, two: 1.0)
  pictures = (100, 60, 95)
  found, _ = attempts.best_of(
    lambda k: Attempt(k, pictures[k]), lambda m: m.number, attempts=3, same=0.05
  )
  assert found.number == 2
  found, _ = attempts.best_of(
    lambda k: Attempt(k, pictures[k]), lambda m: -abs(m.number - 1), attempts=3, same=0.05
  )
  assert found.number != 1


def test_places_of_two_attempts_are_compared_whatever_their_frames(folder):
  one = pycolmap.Reconstruction(str(folder / "out" / "sfm"))
  two = pycolmap.Reconstruction(one)
  two.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0, 0, 1, 0.0])), np.ones(3)))
  assert attempts.apart(one, two) < 1e-6
  assert attempts.apart(one, pycolmap.Reconstruction()) == 1.0
  image = mapping.registered(two)[3]
  width = np.ptp([i.projection_center() for i in mapping.registered(two)], axis=0).max()
  pose = image.cam_from_world()
  moved = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.2 * width, 0, 0]))
  image.frame.set_cam_from_world(image.camera_id, moved)
  assert 0.1 < attempts.apart(one, two) < 0.3
