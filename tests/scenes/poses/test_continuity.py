"""Tests of a film's line."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses import agreement, continuity


def votes_of(place, reach=3, matches=40):
  """Votes of pictures that agree where their places are of one world: `place` names the world."""
  return {
    (i, j): (matches if place[i] == place[j] else 0, matches)
    for i in range(len(place))
    for j in range(i + 1, min(len(place), i + reach + 1))
  }


def test_a_film_in_one_world_is_whole():
  assert not continuity.out_of_line(20, votes_of([0] * 20)).any()
  assert not continuity.out_of_line(1, {}).any()
  assert not continuity.out_of_line(0, {}).any()


@pytest.mark.parametrize("wrong", [[7], [0, 1], [18, 19], [5, 6, 7, 8], [3, 12, 13]])
def test_short_parts_at_the_wrong_place_are_out_of_line(wrong):
  place = [1 if k in wrong else 0 for k in range(20)]
  found = continuity.out_of_line(20, votes_of(place))
  assert np.flatnonzero(found).tolist() == wrong


def test_parts_have_the_votes_of_all_pairs_across_their_ends():
  random = np.random.default_rng(0)
  votes = {pair: tuple(random.integers(0, 9, 2)) for pair in votes_of([0] * 9)}
  for length, *found in continuity._parts(list(range(9)), votes):
    for first in range(9 - length + 1):
      inside = set(range(first, first + length))
      across = [v for (i, j), v in votes.items() if (i in inside) != (j in inside)]
      assert [f[first] for f in found] == np.sum(across, axis=0).tolist()


def test_parts_without_common_matches_contradict_nothing():
  votes = {(i, j): v for (i, j), v in votes_of([0] * 20).items() if not i < 10 <= j}
  assert not continuity.out_of_line(20, votes).any()


def test_a_few_matches_decide_nothing():
  place = [0] * 10 + [1] * 4
  assert not continuity.out_of_line(14, votes_of(place, matches=1)).any()


def test_the_order_is_the_films(monkeypatch):
  taken = []
  images = [
    pycolmap.Image(name=f"frame_{k:06d}.jpg", image_id=20 - k, frame_id=k) for k in range(8)
  ]
  monkeypatch.setattr(continuity, "registered", lambda model: images)

  def pairs(model, database):
    for i in range(8):
      for j in range(i + 1, min(8, i + 4)):
        same = (i == 4) == (j == 4)
        points = np.ones((30, 2), np.uint64)
        points[:, 1] += 0 if same else 1
        yield (images[j].image_id, images[i].image_id), np.zeros((30, 2), int), points

  monkeypatch.setattr(agreement, "matched_points", pairs)

  class Model:
    def deregister_frame(self, key):
      taken.append(key)

  assert continuity.drop_out_of_line(Model(), None) == 1
  assert taken == [4]
