"""Finds pictures of a film whose places contradict what was filmed moments before and after.

Things that look alike (two beds, rows of chairs) hold matches that agree with a place at the wrong
one of them: nothing in a single picture tells. What follows each other in a film sees the same
things, and where neighbours are both placed rightly their matches lead to the same points. Nor does
a hand leap: a picture of a plain wall may agree with its neighbours and yet stand anywhere along
its way. N pictures in the film's order.
"""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.mapping import registered

_NEIGHBOURS = 3  # pictures before and after that see much of the same, chosen
_ASKED = 15  # matches that a verdict needs, as many as a place does
_AGREED = 0.25  # share of them below which a place is wrong: of wrong ones a tenth at most, chosen

_USUAL = 0.9  # share of the steps from picture to picture that are the film's usual speed, chosen
_LEAP = 3.0  # times that speed, chosen; held by hand, the fastest step has 1.1 to 1.8 times

Votes = Mapping[tuple[int, int], tuple[int, int]]
"""Of pairs of pictures, the earlier first: matches that agree on a point, and that see one."""


def out_of_line(count: int, votes: Votes, leaping: Collection[tuple[int, int]] = ()) -> np.ndarray:
  """Tells which pictures contradict those before and after them, bool [N].

  Of all parts of the film, half of it at most, of whose matches with their neighbours too few agree
  the one goes first that has most leaps to them: a part in the wrong place has one on either side,
  what comes after it one. Of several that of whose matches fewest agree, and the shortest; what it
  stood between are neighbours then.

  Args:
    count: Pictures N.
    votes: Of pairs of them.
    leaping: Pairs, the earlier first, between which a hand would have had to leap.
  """
  left = list(range(count))
  while True:
    best, part = (0, _AGREED), None
    for length, agreed, asked, leapt in _parts(left, votes, leaping):
      share = np.where(asked >= _ASKED, agreed / np.maximum(asked, 1), 1.0)
      few = np.flatnonzero(share < _AGREED)
      if len(few):
        first = min(few, key=lambda k: (-leapt[k], share[k]))
        rank = (-int(leapt[first]), float(share[first]))
        if rank < best:
          best, part = rank, (first, length)
    if part is None:
      found = np.ones(count, bool)
      found[left] = False
      return found
    del left[part[0] : part[0] + part[1]]


def _parts(
  left: list[int], votes: Votes, leaping: Collection[tuple[int, int]]
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
  """Yields the votes between all parts of a length and their neighbours.

  Yields:
    The length, and for each first picture [K] how many agree, how many are asked, and how many
    leaps there are.
  """
  count = len(left)
  pair = np.zeros((3, count, _NEIGHBOURS + 1))  # of a picture and the one so many later
  for k in range(count):
    for later in range(1, min(_NEIGHBOURS, count - 1 - k) + 1):
      both = left[k], left[k + later]
      pair[:, k, later] = *votes.get(both, (0, 0)), both in leaping
  border = np.zeros((3, count + 1))  # of pairs that a place lies between
  for k in range(count):
    for later in range(1, _NEIGHBOURS + 1):
      border[:, k + 1 : k + later + 1] += pair[:, k, later, None]
  for length in range(1, count // 2 + 1):
    sums = border[:, : count - length + 1] + border[:, length:]
    for later in range(length + 1, _NEIGHBOURS + 1):  # pairs with the part between them
      for before in range(1, later - length + 1):
        over = np.zeros_like(sums)
        over[:, before:] = pair[:, : sums.shape[1] - before, later]
        sums = sums - 2 * over
    yield length, *sums


def leaps(centers: np.ndarray, times: np.ndarray) -> list[tuple[int, int]]:
  """Returns the pairs of pictures between which a hand would have had to leap.

  A tenth of the steps at most may be leaps, and nine tenths stand still.

  Args:
    centers: Positions [N, 3].
    times: When [s] [N]; where they do not grow, nothing is said.
  """
  passed = np.diff(times)
  if len(times) < 2 or passed.min() <= 0:
    return []
  usual = np.quantile(np.linalg.norm(np.diff(centers, axis=0), axis=1) / passed, _USUAL)
  apart = np.linalg.norm(centers[:, None] - centers, axis=2)
  first, second = np.nonzero(apart > _LEAP * usual * (times - times[:, None]))
  return [(int(i), int(j)) for i, j in zip(first, second, strict=True) if i < j]


def drop_out_of_line(
  model: pycolmap.Reconstruction, database: Path, times: Mapping[str, float]
) -> int:
  """Takes the pose from pictures of a film that are out of its line; returns their number.

  Args:
    model: Poses and points; its pictures' names are in the film's order.
    database: Their features and verified matches.
    times: When each picture was taken [s].
  """
  images = registered(model)
  row = {image.image_id: k for k, image in enumerate(images)}
  votes: dict[tuple[int, int], tuple[int, int]] = {}
  for ids, _, points in agreement.matched_points(model, database):
    first, second = row[ids[0]], row[ids[1]]
    sees = (points != 0).any(axis=1)
    agreed = sees & (points[:, 0] == points[:, 1])
    pair = (min(first, second), max(first, second))
    votes[pair] = int(agreed.sum()), int(sees.sum())
  centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
  leaping = leaps(centers, np.array([times[image.name] for image in images]))
  for pair in leaping:
    votes[pair] = 0, max(votes.get(pair, (0, 0))[1], _ASKED)
  wrong = out_of_line(len(images), votes, set(leaping))
  for image, is_wrong in zip(images, wrong, strict=True):
    if is_wrong:
      model.deregister_frame(image.frame_id)
  return int(wrong.sum())
