"""Models that rest on things alike are made anew without such pairs."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.checks import things_alike
from nerf2real.scenes.poses.checks.overlap import Overlap
from nerf2real.scenes.poses.mapping import registered
from tests.scenes.poses.checks import alike_things


@pytest.fixture
def wrong(alike_matched):
  """Four of the six pictures of the first of two things are before the second."""
  truth, database = alike_matched
  model = pycolmap.Reconstruction(truth)
  for row in range(1, 5):
    alike_things.mistake(model, database, registered(model)[row], joined=False)
  return model


def _verified(database):
  with pycolmap.Database.open(str(database)) as db:
    return {pycolmap.pair_id_to_image_pair(pair) for pair in db.read_two_view_geometries()[0]}


def test_a_model_of_which_a_group_lacks_what_it_ought_to_see_is_made_anew(alike_matched, wrong):
  truth, database = alike_matched
  before, asked = _verified(database), []

  def map_again(copy):
    asked.append(before - _verified(copy))
    return pycolmap.Reconstruction(truth), "a mapper", 0.01

  found = things_alike.undeceived(
    things_alike.Found(wrong, "another", 0.0), database, map_again, seed=0
  )
  assert things_alike.doubtful(wrong) and not things_alike.doubtful(found.model)
  for one, same in zip(registered(found.model), registered(truth), strict=True):
    np.testing.assert_array_equal(one.projection_center(), same.projection_center())
  assert found.mapper == f"a mapper, without {len(asked[-1])} pairs of things alike"
  assert found.apart == 0.01
  assert _verified(database) == before
  assert all(asked)


@pytest.mark.parametrize("answer", ["the same", "nothing"])
def test_a_model_that_is_not_better_is_not_taken(alike_matched, wrong, answer):
  _, database = alike_matched
  found = things_alike.Found(wrong, "a mapper", 0.02)
  other = pycolmap.Reconstruction(wrong) if answer == "the same" else None
  kept = things_alike.undeceived(found, database, lambda _: (other, "another", 0.5), seed=0)
  assert kept is found


def test_a_model_that_lacks_more_is_not_taken_where_most_is_lacking(alike_matched, monkeypatch):
  truth, database = alike_matched
  other = pycolmap.Reconstruction(truth)
  nothing = np.zeros((0, 0))
  monkeypatch.setattr(
    things_alike,
    "overlap",
    lambda model: Overlap([], nothing, nothing, -100.0 if model is truth else -105.0),
  )
  pairs = {next(iter(_verified(database)))}
  monkeypatch.setattr(things_alike, "_turning", lambda *_: pairs)
  monkeypatch.setattr(things_alike, "_holding", lambda *_: set())
  found = things_alike.Found(truth, "a mapper", 0.0)
  kept = things_alike.undeceived(found, database, lambda _: (other, "another", 0.0), seed=0)
  assert kept is found


def test_right_places_are_not_mapped_again(folder):
  found = things_alike.Found(pycolmap.Reconstruction(str(folder / "out" / "sfm")), "a mapper", 0.0)

  def map_again(_):
    raise AssertionError

  database = folder / "out" / "work" / "database.db"
  assert things_alike.undeceived(found, database, map_again, seed=0) is found
  assert things_alike.doubtful(found.model) == []
