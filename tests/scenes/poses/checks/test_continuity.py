"""Tests of a film's line."""

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.checks import agreement, continuity


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
  leaping = {pair for pair in votes if random.random() < 0.3}
  counted = {pair: (*v, pair in leaping) for pair, v in votes.items()}
  for length, *found in continuity._parts(list(range(9)), votes, leaping):
    for first in range(9 - length + 1):
      inside = set(range(first, first + length))
      across = [v for (i, j), v in counted.items() if (i in inside) != (j in inside)]
      assert [f[first] for f in found] == np.sum(across, axis=0).tolist()


def test_a_part_with_a_leap_on_either_side_goes_before_what_follows_it():
  """Matches of things alike agree before it, none after it: by them alone the film's end goes."""
  place = [1 if 9 <= k < 14 else 0 for k in range(20)]
  votes = votes_of(place)
  for i in range(6, 9):  # see the thing that is taken for another
    votes |= {(i, j): (12, 40) for j in range(9, i + 4)}
  found = continuity.out_of_line(20, votes)
  assert np.flatnonzero(found).tolist() == list(range(14, 20))
  found = continuity.out_of_line(20, votes, {(8, 9), (13, 14)})
  assert np.flatnonzero(found).tolist() == list(range(9, 14))


def test_parts_without_common_matches_contradict_nothing():
  votes = {(i, j): v for (i, j), v in votes_of([0] * 20).items() if not i < 10 <= j}
  assert not continuity.out_of_line(20, votes).any()


def test_a_few_matches_decide_nothing():
  place = [0] * 10 + [1] * 4
  assert not continuity.out_of_line(14, votes_of(place, matches=1)).any()


def test_the_order_is_the_films(monkeypatch):
  taken, other_world = [], [4]
  images = [
    pycolmap.Image(name=f"frame_{k:06d}.jpg", image_id=40 - k, frame_id=k) for k in range(25)
  ]
  monkeypatch.setattr(continuity, "registered", lambda model: images)
  monkeypatch.setattr(pycolmap.Image, "projection_center", lambda image: np.zeros(3))

  def pairs(model, database):
    for i in range(25):
      for j in range(i + 1, min(25, i + 4)):
        same = (i in other_world) == (j in other_world)
        points = np.ones((30, 2), np.uint64)
        points[:, 1] += 0 if same else 1
        yield (images[j].image_id, images[i].image_id), np.zeros((30, 2), int), points

  monkeypatch.setattr(agreement, "matched_points", pairs)

  class Model:
    def deregister_frame(self, key):
      taken.append(key)

  times = {f"frame_{k:06d}.jpg": 0.5 * k for k in range(25)}
  assert continuity.drop_out_of_line(Model(), None, times) == 1
  assert taken == [4]
  taken.clear()
  other_world.clear()
  places = np.arange(25.0)
  places[6] = 40.0  # all matches agree with it, and no hand gets there and back
  monkeypatch.setattr(pycolmap.Image, "projection_center", lambda i: [places[i.frame_id], 0, 0])
  assert continuity.drop_out_of_line(Model(), None, times) == 1
  assert taken == [6]


def test_a_leap_is_a_way_that_the_films_usual_speed_does_not_allow():
  times = np.arange(30) * 0.5
  centers = np.zeros((30, 3))
  centers[:, 0] = np.cumsum(np.random.default_rng(0).uniform(0.0, 0.2, 30))
  assert continuity.leaps(centers, times) == []
  waits = np.maximum(centers[:, 0] - centers[22, 0], 0.0)  # three quarters of it stand still
  assert continuity.leaps(np.stack([waits, 0 * waits, 0 * waits], 1), times) == []
  centers[9, 1] = 0.8
  found = continuity.leaps(centers, times)
  assert {(8, 9), (9, 10)} <= set(found) and all(9 in pair for pair in found)
  assert continuity.leaps(centers, times[::-1]) == []
  assert continuity.leaps(centers[:1], times[:1]) == []
