"""Tests of the pairs of keyframes that are matched."""

import itertools

import cv2
import numpy as np
import pytest

from nerf2real.scenes.poses.matching.features import FeatureSettings
from nerf2real.scenes.poses.matching.pairs import (
  PairSettings,
  choose_pairs,
  loop_pairs,
  overlap_scores,
  repair_pairs,
  sequential_pairs,
  sparse_keyframes,
)


def components(count, pairs):
  """Number of connected components of an undirected graph, by union-find."""
  parent = list(range(count))

  def root(node):
    while parent[node] != node:
      node = parent[node]
    return node

  for a, b in pairs:
    parent[root(a)] = root(b)
  return len({root(node) for node in range(count)})


def scores_of_a_loop(keyframes, count):
  """Overlap of keyframes on two rounds through one room: near in phase means many matches."""
  phase = (keyframes[:, None] - keyframes[None]) % (count // 2)
  phase = np.minimum(phase, count // 2 - phase)
  return np.maximum(0, 60 - phase)


@pytest.mark.parametrize("count", [250, 500, 1000])
def test_pairs_grow_linearly_and_connect_everything(count):
  settings = PairSettings()
  pairs, words = choose_pairs(
    np.full(count, 2000), settings, score=lambda keyframes: scores_of_a_loop(keyframes, count)
  )
  assert "sequential" in words
  assert "loop closures" in words
  assert len(set(pairs)) == len(pairs)
  assert all(0 <= a < b < count for a, b in pairs)
  assert components(count, pairs) == 1
  most = count * (settings.overlap + 3) + settings.loop_keyframes * settings.loop_closures
  assert len(pairs) <= most
  assert len(pairs) < 0.25 * count * (count - 1) / 2 or count < 500
  second_round = [(a, b) for a, b in pairs if abs(b - a - count // 2) < 10]
  assert len(second_round) > 50  # the second round is tied to the first


def test_loops_of_a_dense_film_are_closed_with_places_seen_before_not_with_moments_ago():
  """A camera that goes round twice: what it sees is alike in neighbours, and a round later."""
  count, lap = 1000, 500

  def score(keyframes):
    apart = np.abs(keyframes[:, None] - keyframes[None])
    near = np.minimum(apart, np.abs(apart - lap))
    return np.where(apart == 0, 0, np.maximum(0, 200 - near - 40 * (apart > lap // 2)))

  pairs, _ = choose_pairs(np.full(count, 4000), PairSettings(), score=score)
  again = {i for pair in pairs if abs(pair[1] - pair[0] - lap) <= 8 for i in pair}
  assert len(again) >= count // 4 - 8  # nearly every keyframe that is scored


def test_few_keyframes_are_matched_exhaustively():
  def never(_):
    raise AssertionError("no scores are needed")

  pairs, words = choose_pairs(np.full(30, 4000), PairSettings(), score=never)
  assert words.startswith("exhaustive")
  assert sorted(pairs) == list(itertools.combinations(range(30), 2))


def test_the_bound_is_the_cost_not_the_number():
  few = choose_pairs(np.full(150, 1000), PairSettings(), score=None)
  assert few[1].startswith("exhaustive")
  many = choose_pairs(
    np.full(150, 3000), PairSettings(), score=lambda k: np.zeros((len(k), len(k)), int)
  )
  assert many[1].startswith("sequential")


def test_features_shrink_smoothly_with_the_number_of_pictures():
  settings = FeatureSettings()
  counts = np.array([settings.of_each(number) for number in range(1, 400)])
  assert counts[0] == settings.few_num_features and counts[-1] == settings.max_num_features
  change = counts[1:] / counts[:-1]
  assert change.max() <= 1 and change.min() > 0.9  # no number from which much is lost
  number = np.arange(1, 400)
  cost = number * (number - 1) / 2 * counts.astype(float) ** 2
  assert cost[counts > settings.max_num_features].max() <= settings.most_products


def test_sequential_pairs_by_hand():
  assert sorted(sequential_pairs(5, 1)) == [
    (0, 1),
    (0, 2),
    (0, 4),
    (1, 2),
    (1, 3),
    (2, 3),
    (2, 4),
    (3, 4),
  ]
  np.testing.assert_array_equal(sparse_keyframes(10, 4), [0, 3, 6, 9])
  assert len(sparse_keyframes(1000, 300)) <= 300


def test_loop_pairs_by_hand():
  keyframes = np.array([0, 10, 20, 30])
  scores = np.array([[0, 9, 8, 2], [9, 0, 7, 6], [8, 7, 0, 5], [2, 6, 5, 0]])
  chosen = loop_pairs(keyframes, scores, min_distance=10, per_keyframe=1, min_score=3)
  assert chosen == [(0, 20), (10, 30)]


def test_repair_pairs_reach_the_whole_capture_and_stay_bounded():
  pairs = repair_pairs([100], 1000, overlap=10, loop_keyframes=300)
  others = {a + b - 100 for a, b in pairs}
  assert set(range(70, 131)) - {100} <= others
  assert min(others) < 10
  assert max(others) > 990
  assert len(repair_pairs(range(500), 1000, overlap=10, loop_keyframes=300)) < 1000 * 45


def test_overlap_scores_against_brute_force():
  generator = np.random.default_rng(0)
  base = generator.normal(size=(40, 16))
  descriptors = np.stack(
    [
      base[generator.permutation(40)[:20]] + 0.05 * generator.normal(size=(20, 16))
      for _ in range(5)
    ]
  ).astype(np.float32)
  descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
  descriptors[4, 12:] = 0
  scores = overlap_scores(descriptors, ratio=0.85)
  for i, j in itertools.permutations(range(5), 2):
    a, b = (i, j) if i > j else (j, i)
    first = descriptors[a][np.abs(descriptors[a]).sum(1) > 0]
    second = descriptors[b][np.abs(descriptors[b]).sum(1) > 0]
    forward = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher(cv2.NORM_L2).match(second, first)}
    expected = sum(
      m.distance < 0.85 * n.distance and back[m.trainIdx] == m.queryIdx for m, n in forward
    )
    assert abs(scores[i, j] - expected) <= (1 if 4 in (i, j) else 0)
  np.testing.assert_array_equal(scores, scores.T)
