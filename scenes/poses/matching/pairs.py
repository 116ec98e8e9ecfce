"""Selects image pairs to match: all of few, sequential and loop-closure pairs of many.

Matching costs time in proportion to the product of both numbers of features. A walk of N
keyframes is therefore matched

- exhaustively, while all pairs together stay under a cost measured below;
- else sequentially (each keyframe with the next few, and with others further away), plus loop
  closures: all pairs of a sparse set of keyframes are scored by their largest features, which is
  a hundred times cheaper than matching, and each keyframe's best scoring partners are matched.

The number of pairs grows linearly with N. Shapes: N keyframes, M sparse keyframes, K features.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import numpy as np

from nerf2real.core.progress import Progress, no_progress

Pair = tuple[int, int]  # indices of two keyframes, the smaller first


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairSettings:
  """Settings of the pair selection."""

  exhaustive_cost: float = 1.6e10
  """Products of feature counts that may be compared exhaustively."""
  # measured 5.2e-9 CPU s each on a 2-core machine, so 80 CPU s; 11,325 pairs of 1,090 features fit
  overlap: int = 8
  """Following keyframes that each one is matched with (COLMAP: 10)."""
  loop_keyframes: int = 300
  """At most this many keyframes are scored for loop closures."""
  loop_closures: int = 12
  """Partners that each scored keyframe is matched with."""
  score_features: int = 256
  """Largest features of a keyframe that take part in scoring."""
  score_ratio: float = 0.85
  """Nearest to second-nearest descriptor distance in scoring."""
  min_score: int = 5
  """Mutual matches of a pair worth matching: of the living room's verified pairs."""
  # further than 10 keyframes apart 97 % have them, of all others a quarter has not


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
  """Pairs each keyframe with the next `overlap` ones and with those 2 overlap, 4 overlap, ... away.

  The far ones stop at 8 overlap, so that the number stays below count * (overlap + 3).
  """
  steps = [*range(1, overlap + 1), *(overlap * 2**power for power in (1, 2, 3))]
  return [(i, i + step) for step in steps for i in range(count - step)]


def sparse_keyframes(count: int, limit: int) -> np.ndarray:
  """Returns the indices [M] of every k-th keyframe, M at most `limit`, k as small as possible."""
  return np.arange(0, count, -(-count // limit))


def overlap_scores(
  descriptors: np.ndarray, *, ratio: float, progress: Progress = no_progress
) -> np.ndarray:
  """Counts mutual nearest neighbours that pass the ratio test for every pair of pictures.

  Source: Wu 2013, Towards linear-time incremental structure from motion, section 3 (preemptive
  matching).

  Args:
    descriptors: float32 [M, K, D], of length 1; rows of zeros where a picture has fewer than K.
    ratio: Largest ratio of nearest to second-nearest distance.
    progress: Called with the fraction done and a text.

  Returns:
    Symmetric counts int [M, M], zero on the diagonal.
  """
  count, features, width = descriptors.shape
  scores = np.zeros((count, count), np.int64)
  flat = descriptors.reshape(-1, width)
  columns = np.arange(features)
  for i in range(1, count):
    similarity = (descriptors[i] @ flat[: i * features].T).reshape(features, i, features)
    nearest = similarity.argmax(axis=2)  # [K, i]
    back = similarity.argmax(axis=0)  # [i, K]
    first = similarity.max(axis=2)
    np.put_along_axis(similarity, nearest[..., None], -1.0, axis=2)
    second = similarity.max(axis=2)
    # Squared distances of unit vectors are 2 - 2 cos.
    passed = (1 - first < ratio**2 * (1 - second)) & (first > 0)
    mutual = np.take_along_axis(back, nearest.T, axis=1) == columns  # [i, K]
    scores[i, :i] = (mutual & passed.T).sum(axis=1)
    if i % 10 == 0:
      progress((i / count) ** 2, "looking for loop closures")
  return scores + scores.T


def loop_pairs(
  keyframes: np.ndarray, scores: np.ndarray, *, min_distance: int, per_keyframe: int, min_score: int
) -> list[Pair]:
  """Chooses the best scoring partners of every keyframe that the sequence does not pair anyway.

  Args:
    keyframes: Indices of the scored keyframes [M].
    scores: Symmetric scores [M, M].
    min_distance: Keyframes this close are paired by the sequence.
    per_keyframe: Partners for each keyframe.
    min_score: Pairs below it are not worth matching.
  """
  far = np.abs(keyframes[:, None] - keyframes[None]) > min_distance
  candidates = np.where(far, scores, 0)
  chosen: set[Pair] = set()
  for row, index in enumerate(keyframes):
    for column in np.argsort(-candidates[row], kind="stable")[:per_keyframe]:
      if candidates[row, column] >= min_score:
        other = keyframes[column]
        chosen.add((int(min(index, other)), int(max(index, other))))
  return sorted(chosen)


def repair_pairs(
  missing: Iterable[int], count: int, *, overlap: int, loop_keyframes: int
) -> list[Pair]:
  """Pairs keyframes that found no place with their wider neighbours and with sparse keyframes.

  Args:
    missing: Indices of the keyframes outside of the largest model.
    count: Number of all keyframes.
    overlap: The sequence's overlap; its threefold is tried here.
    loop_keyframes: Number of sparse keyframes, spread over the whole capture.
  """
  missing = list(missing)
  # At most about overlap * count pairs more, however many are missing.
  limit = max(10, min(loop_keyframes, overlap * count // max(len(missing), 1)))
  sparse = sparse_keyframes(count, limit)
  chosen: set[Pair] = set()
  for index in missing:
    near = range(max(0, index - 3 * overlap), min(count, index + 3 * overlap + 1))
    for other in (*near, *sparse):
      if other != index:
        chosen.add((int(min(index, other)), int(max(index, other))))
  return sorted(chosen)


def choose_pairs(
  feature_counts: np.ndarray, settings: PairSettings, *, score: Callable[[np.ndarray], np.ndarray]
) -> tuple[list[Pair], str]:
  """Chooses the pairs of a capture.

  Args:
    feature_counts: Features of each keyframe [N].
    settings: How keyframes are paired.
    score: Maps indices of keyframes [M] to their symmetric overlap scores [M, M]; called only where
      loop closures are looked for.

  Returns:
    The pairs, and the strategy in words.
  """
  counts = np.asarray(feature_counts, np.float64)
  number = len(counts)
  cost = (counts.sum() ** 2 - (counts**2).sum()) / 2
  if cost <= settings.exhaustive_cost:
    everything = list(itertools.combinations(range(number), 2))
    return everything, f"exhaustive ({number} keyframes)"
  chain = sequential_pairs(number, settings.overlap)
  keyframes = sparse_keyframes(number, settings.loop_keyframes)
  # In sparse keyframes: what the camera saw moments ago scores best, and closes no loop.
  apart = settings.overlap * int(keyframes[1] - keyframes[0]) if len(keyframes) > 1 else 0
  loops = loop_pairs(
    keyframes,
    score(keyframes),
    min_distance=apart,
    per_keyframe=settings.loop_closures,
    min_score=settings.min_score,
  )
  words = (
    f"sequential (overlap {settings.overlap}) plus {len(loops)} loop closures among "
    f"{len(keyframes)} sparse keyframes"
  )
  return sorted({*chain, *loops}), words
