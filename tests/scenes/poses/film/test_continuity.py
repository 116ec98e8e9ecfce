"""Tests of a film's line."""

import itertools

import numpy as np
import pycolmap
import pytest

from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.checks.overlap import Overlap
from nerf2real.scenes.poses.film import continuity

COUNT = 80
TIMES = 0.4 * np.arange(COUNT)
NONE = np.zeros((COUNT, COUNT), bool)


def votes_of(elsewhere, reach=4, matches=40):
  """Votes of pictures that agree where their places are of one world; all others are of one."""
  place = np.zeros(COUNT, int)
  place[elsewhere] = 1
  near = np.triu(np.ones((COUNT, COUNT), bool), 1) & ~np.triu(np.ones((COUNT, COUNT), bool), reach)
  asked = np.where(near, matches, 0)
  return continuity.Votes(asked * (place == place[:, None]), asked)


def out(votes, leaping=NONE):
  return np.flatnonzero(continuity.out_of_line(TIMES, votes, leaping)).tolist()


def test_a_film_in_one_world_is_whole():
  assert out(votes_of([])) == []
  for count in (0, 1, 2):
    nothing = np.zeros((count, count), int)
    votes = continuity.Votes(nothing, nothing)
    assert not continuity.out_of_line(TIMES[:count], votes, nothing > 0).any()


@pytest.mark.parametrize("wrong", [[0, 1, 2], [77, 78, 79], [5, 6, 7, 8], [13, 14, 15, 42, 43, 44]])
def test_short_parts_at_the_wrong_place_are_out_of_line(wrong):
  assert out(votes_of(wrong)) == wrong


def test_parts_without_common_matches_contradict_nothing():
  votes = votes_of(range(70, 80))
  votes.asked[:70, 70:] = 0
  assert out(votes) == []


def test_a_few_matches_decide_nothing():
  assert out(votes_of(range(70, 80), matches=1)) == []


def test_a_part_that_contradicts_on_both_sides_goes_before_what_follows_it():
  """Matches of things alike agree before it, none after it."""
  wrong = list(range(60, 65))
  votes = votes_of(wrong)
  votes.agreed[57:60, 60:63] = votes.asked[57:60, 60:63] * 0.3
  assert out(votes) == wrong


def test_parts_that_stand_elsewhere_go_and_not_what_is_between_them():
  """They contradict it in few matches, and what is around the three of them in many."""
  wrong = [*range(20, 30), *range(50, 55)]
  votes = votes_of(wrong)
  for inner, outer in ((29, 30), (49, 50)):
    votes.asked[inner - 3 : inner + 1, outer : outer + 4] = 0
    votes.asked[inner, outer] = 16
  assert out(votes) == wrong


def test_pictures_that_stand_each_elsewhere_are_one_part():
  votes = votes_of(range(30, 36))
  votes.agreed[30:36, 30:36] = 0
  assert out(votes) == list(range(30, 36))


def test_a_leap_tells_where_matches_say_nothing():
  votes, leaping = votes_of([]), NONE.copy()
  for first, second in itertools.combinations(range(COUNT), 2):
    if (first in range(30, 37)) != (second in range(30, 37)):
      votes.asked[first, second] = 0
      leaping[first, second] = second < first + 9
  assert out(votes) == []
  assert out(votes, leaping) == list(range(30, 37))


def test_pictures_far_apart_in_time_may_contradict():
  """As many as agree do in this film: what a gap parts stays, whatever is alike beyond it."""
  votes = votes_of(range(40, 45))
  for first in range(COUNT):
    for second in range(first + 5, min(first + 9, COUNT)):
      votes.asked[first, second] = 40
      votes.agreed[first, second] = 40 * ((first + second) % 2)
  assert out(votes) == list(range(40, 45))
  for first in range(35, 40):
    for second in range(45, 49):
      votes.asked[first, second], votes.agreed[first, second] = 40, 0
  assert out(votes) == list(range(40, 45))


def test_the_order_is_the_films_and_deceiving_pairs_are_named(monkeypatch):
  taken, other_world = [], [4, 5, 6]
  images = [pycolmap.Image(name=f"{k:03d}", image_id=100 - k, frame_id=k) for k in range(COUNT)]
  monkeypatch.setattr(continuity, "registered", lambda model: images)
  monkeypatch.setattr(pycolmap.Image, "projection_center", lambda image: np.zeros(3))

  def pairs(model, database):
    for i, j in itertools.combinations(range(COUNT), 2):
      if j < i + 4 or (i, j) == (5, 60):
        same = (i in other_world) == (j in other_world) or j == 60
        points = np.ones((30, 2), np.uint64)
        points[:, 1] += 0 if same else 1
        yield (images[j].image_id, images[i].image_id), np.zeros((30, 2), int), points

  monkeypatch.setattr(agreement, "matched_points", pairs)
  nothing = Overlap([*range(COUNT)], np.zeros((COUNT, COUNT)), np.zeros((COUNT, COUNT)), 0.0)
  monkeypatch.setattr(continuity, "overlap", lambda model: nothing)

  class Model:
    def deregister_frame(self, key):
      taken.append(key)

  times = {image.name: float(when) for image, when in zip(images, TIMES, strict=True)}
  found = continuity.drop_out_of_line(Model(), None, times)
  assert found.names == {"004", "005", "006"} and taken == [4, 5, 6]
  assert found.misled == {(95, 40)}


def test_what_is_left_out_is_told_by_its_times():
  times = {f"{k}": 0.5 * k for k in range(10)}
  placed = set("0127")
  assert "from 1.5 s to 3.0 s stand apart" in continuity.gaps({"3", "4", "6"}, placed, times)
  text = continuity.gaps({"3", "8", "9"}, placed, times)
  assert text.startswith("Pictures at 1.5 s, from 4.0 s to 4.5 s stand apart")
  assert "those parts" in text


def walk(count: int) -> tuple[np.ndarray, np.ndarray]:
  """A hand that turns and changes its speed, and when: [N, 3], [N]."""
  times = np.cumsum(np.random.default_rng(0).uniform(0.2, 0.6, count))
  return np.stack([np.sin(0.5 * times), np.cos(0.3 * times), 0.1 * np.sin(times)], 1), times


def test_a_hand_does_not_leap_however_fast_it_is():
  centers, times = walk(60)
  assert not continuity.leaps(centers, times).any()
  assert not continuity.leaps(10 * centers, times).any()
  waits = np.maximum(np.arange(60.0) - 45, 0.0)  # three quarters of it stand still
  assert not np.diagonal(
    continuity.leaps(np.stack([waits, 0 * waits, 0 * waits], 1), times), 1
  ).any()


def test_pictures_that_stand_elsewhere_are_leapt_to_and_from():
  centers, times = walk(60)
  centers[20:27, 2] += 1.0
  found = continuity.leaps(centers, times)
  assert np.flatnonzero(np.diagonal(found, 1)).tolist() == [19, 26]
  assert not np.tril(found).any()


def test_a_knock_is_no_leap():
  """The hand's velocity changes, but it comes out close to where it would have been."""
  centers, times = walk(60)
  times[20] = times[19] + 0.03
  centers[20] = centers[19] + [0.0, 0.0, 0.1]
  assert not np.diagonal(continuity.leaps(centers, times), 1).any()


def test_without_times_nothing_is_said():
  centers, times = walk(60)
  centers[20, 2] += 5.0
  assert not continuity.leaps(centers, times[::-1]).any()
  assert not continuity.leaps(centers[:2], times[:2]).any()
  assert continuity.leaps(centers[:0], times[:0]).shape == (0, 0)


def seen_of(world: np.ndarray, reach: int = 12) -> Overlap:
  """What pictures have in common within their world: those of as many places elsewhere in a film
  do, and lack it of the other."""
  near = abs(np.subtract.outer(np.arange(len(world)), np.arange(len(world)))) % reach < 4
  same = world == world[:, None]
  return Overlap([*range(len(world))], 9.0 * (near & same), 9.0 * (near & ~same), 0.0)


def test_every_other_part_is_a_group():
  parts = np.repeat(np.arange(6), [12, 9, 12, 9, 12, 9])
  assert (continuity.smaller_group(parts, seen_of(parts % 2)) == (parts % 2 == 1)).all()


def test_the_smaller_group_is_that_of_fewer_pictures():
  parts = np.repeat(np.arange(4), [30, 4, 4, 4])
  world = np.array([0, 1, 1, 1])[parts]
  assert (continuity.smaller_group(parts, seen_of(world)) == (world == 1)).all()


def test_parts_of_one_world_are_no_groups():
  parts = np.repeat(np.arange(4), 10)
  assert not continuity.smaller_group(parts, seen_of(0 * parts)).any()
  assert not continuity.smaller_group(
    0 * parts, seen_of(parts % 2)
  ).any()  # nothing contradicts in the film
  assert len(continuity.smaller_group(parts[:0], seen_of(parts[:0]))) == 0


def test_a_small_lack_is_not_clear():
  seen = seen_of(np.zeros(40, int))
  seen.missing[20:23] += 1.0
  parts = np.repeat(np.arange(3), [20, 3, 17])
  assert not continuity.smaller_group(parts, seen).any()
