"""Finds pictures of a film whose places contradict what was filmed moments before and after.

Things that look alike (two beds, rows of chairs) hold matches that agree with a place at the wrong
one of them: nothing in a single picture tells. What follows each other in a film sees the same
things, and where neighbours are both placed rightly their matches lead to the same points. Nor does
a hand leap (`leaps`). What was filmed seconds apart may have nothing in common but things alike,
and contradict at right places: how many pairs so far apart do is counted in the film, and what a
pair says is worth the less the more do.

The film is a line then, of which parts stand elsewhere: the smaller of two groups that clearly lack
each other, and those without which least is left that contradicts. Before two windows alike every
other part may stand at the other one, so that half of the film does: each part is whole, and
contradicts what comes before and after it; which belong together what they ought to see of each
other tells, whenever they were filmed (`overlap`). Evidence is log odds, which add.
Shapes: N pictures in the film's order.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks import agreement
from nerf2real.scenes.poses.checks.division import divide
from nerf2real.scenes.poses.checks.overlap import CLEAR, Overlap, overlap
from nerf2real.scenes.poses.mapping import registered

_NEIGHBOURS = 3  # pictures before and after that see much of the same, chosen
_ASKED = 15  # matches that a verdict needs, as many as a place does
_ALIKE = 200  # pairs about as far apart in time of which those that contradict are counted, chosen
_ROUNDS = 3  # of counting without the pictures that stand elsewhere
# Against a part that stands elsewhere, and against each more of its pictures. Chosen: a part begins
# at one picture of twenty at most, and has about ten.
_BEGINS = float(np.log(0.95 / 0.05))
_GOES_ON = 0.1
_LEAP = 6.0  # times the median change of velocity, chosen: at right places 4.6 times at most, where
# things alike deceive 10 and more
_USUAL = 0.9  # share of the steps from picture to picture that are as long as the film's usual one
# at most, chosen: a hand that is knocked changes its velocity, but goes no farther


class Votes(NamedTuple):
  """What matches of pairs of pictures say, the earlier first."""

  agreed: np.ndarray  # matches that lead both to one point [N, N]
  asked: np.ndarray  # matches of which a picture sees a point [N, N]


class OutOfLine(NamedTuple):
  """Pictures that lost their place."""

  names: frozenset[str]
  misled: frozenset[tuple[int, int]]
  """Their ids, each with that of a picture most of whose matches had agreed with the lost place."""


def out_of_line(times: np.ndarray, votes: Votes, leaping: np.ndarray) -> np.ndarray:
  """Tells which pictures stand elsewhere than those before and after them, bool [N].

  Args:
    times: When each picture was taken [s] [N].
    votes: Of pairs of them.
    leaping: Between which a hand would have had to leap, bool [N, N].
  """
  kept = np.ones(len(times), bool)
  for _ in range(_ROUNDS):
    before, kept = kept, _line(_evidence(times, votes, leaping, kept))
    if (before == kept).all():
      break
  return ~kept


def _parts(times: np.ndarray, votes: Votes, leaping: np.ndarray) -> np.ndarray:
  """Counts the parts of a film, each of which contradicts the one before, [N]."""
  evidence = _evidence(times, votes, leaping, np.ones(len(times), bool))
  return np.cumsum(np.append(False, np.diagonal(evidence, 1) > 0))[: len(times)]


def _evidence(times: np.ndarray, votes: Votes, leaping: np.ndarray, kept: np.ndarray) -> np.ndarray:
  """What says that two pictures are not of one line if they follow each other, log odds [N, N].

  It is the mean over the matches of them and their neighbours of what their pairs are worth, for
  one that agrees the negative, and what a leap is worth.
  """
  count = len(times)
  worth = _worth(times, votes, kept)
  against = np.pad(worth * (votes.asked - 2.0 * votes.agreed), _NEIGHBOURS)
  asked = np.pad(votes.asked, _NEIGHBOURS)
  sums = np.zeros((2, count, count))
  for before in range(_NEIGHBOURS):
    rows = slice(_NEIGHBOURS - before, _NEIGHBOURS - before + count)
    for after in range(_NEIGHBOURS - before):
      columns = slice(_NEIGHBOURS + after, _NEIGHBOURS + after + count)
      sums += against[rows, columns], asked[rows, columns]
  mean = np.where(sums[1] >= _ASKED, sums[0] / np.maximum(sums[1], 1), 0.0)
  found: np.ndarray = mean + leaping * _log_odds(0, count)
  return found


def _worth(times: np.ndarray, votes: Votes, kept: np.ndarray) -> np.ndarray:
  """Log odds [N, N] that two right pictures as far apart in time do not contradict, 0 at least."""
  gaps = times - times[:, None]
  known = (votes.asked >= _ASKED) & kept & kept[:, None]
  order = np.argsort(gaps[known], kind="stable")
  apart = gaps[known][order]
  contradict = (votes.agreed < votes.asked / 2)[known][order]
  middle = (np.searchsorted(apart, gaps) + np.searchsorted(apart, gaps, side="right")) // 2
  begin = np.clip(middle - _ALIKE // 2, 0, max(len(apart) - _ALIKE, 0))
  end = np.minimum(begin + _ALIKE, len(apart))
  total = np.concatenate([[0], np.cumsum(contradict)])
  return np.maximum(_log_odds(total[end] - total[begin], end - begin), 0.0)


def _log_odds(seen: np.ndarray | int, count: np.ndarray | int) -> np.ndarray:
  """Against what was seen in some of a count (Jeffreys' prior)."""
  share = (np.asarray(seen) + 0.5) / (np.asarray(count) + 1.0)
  return np.log((1 - share) / share)


def _line(evidence: np.ndarray) -> np.ndarray:
  """Which pictures a film's line goes through, bool [N], by the least sum of what contradicts it.

  That is what it costs to say that parts, each half of the film at most, stand elsewhere, and the
  evidence against what is said: that pictures are of one line, which follow each other in it or in
  a part, or that they are not, at a part's ends. In a part another may begin, without a cost beyond
  a part's.
  """
  count = len(evidence)
  evidence = np.pad(evidence, 1)  # an end before and after the film
  steps = np.diagonal(evidence, 1)
  within = np.concatenate([[0.0], np.cumsum(np.clip(steps, 0.0, _BEGINS))])
  agree = np.maximum(-steps, 0.0)
  best, before = np.zeros(count + 2), np.zeros(count + 2, int)
  for last in range(1, count + 2):
    first = np.arange(max(last - 1 - count // 2, 0), last - 1)  # before a part
    parts = _BEGINS + _GOES_ON * (last - 1 - first) + within[last - 1] - within[first + 1]
    parts += agree[first] + agree[last - 1] + np.maximum(evidence[first, last], 0.0)
    costs = np.append(best[first] + parts, best[last - 1] + max(steps[last - 1], 0.0))
    least = len(first) if costs[-1] <= costs.min() + 1e-9 else int(np.argmin(costs))
    best[last], before[last] = costs[least], np.append(first, last - 1)[least]
  kept = np.zeros(count + 2, bool)
  at = count + 1
  while at:
    at = before[at]
    kept[at] = True
  return kept[1:-1]


def leaps(centers: np.ndarray, times: np.ndarray) -> np.ndarray:
  """Tells between which pictures a hand would have had to leap, bool [N, N], the earlier first.

  It leaps where its velocity is not that before nor that after, by far more than between most
  pictures as many apart, and it comes out farther off than a usual step is long: a hand goes on
  much as it moved the moment before, or after.

  Args:
    centers: Positions [N, 3].
    times: When [s] [N]; where they do not grow, nothing is said.
  """
  count = len(times)
  found = np.zeros((count, count), bool)
  if count < 3 or np.diff(times).min() <= 0:
    return found
  way, passed = centers - centers[:, None], times - times[:, None]
  steps = np.diff(centers, axis=0)
  velocity = steps / np.diff(times)[:, None]
  off = np.full((2, count, count), np.inf)  # from where the hand before, and after, leads
  off[0, 1:] = np.linalg.norm(way[1:] - velocity[:, None] * passed[1:, :, None], axis=2)
  off[1, :, :-1] = np.linalg.norm(way[:, :-1] - velocity * passed[:, :-1, None], axis=2)
  usual = np.quantile(np.linalg.norm(steps, axis=1), _USUAL)
  for later in range(1, count):
    first = np.arange(count - later)
    second = first + later
    nearest = off[:, first, second].min(axis=0)
    change = nearest / passed[first, second]
    found[first, second] = (change > _LEAP * np.median(change)) & (nearest > usual)
  return found


def smaller_group(parts: np.ndarray, seen: Overlap) -> np.ndarray:
  """Tells which pictures are of the smaller of two groups that clearly lack each other, bool [N].

  Single pictures do not tell it: blurred ones have little in common.

  Args:
    parts: Of which part of the film each picture is, counted from 0 [N].
    seen: What the pictures have in common.
  """
  of_part = np.arange(parts.max(initial=-1) + 1)[:, None] == parts
  weights = of_part @ (seen.common - seen.missing) @ of_part.T
  between = weights - np.diag(np.diagonal(weights))
  group = divide(between)
  if group is None or between[group][:, ~group].sum() > -CLEAR * abs(weights.sum()) / 2:
    return np.zeros(len(parts), bool)
  found: np.ndarray = group[parts]
  return found if 2 * found.sum() <= len(parts) else ~found


def drop_out_of_line(
  model: pycolmap.Reconstruction, database: Path, times: Mapping[str, float]
) -> OutOfLine:
  """Takes the pose from pictures of a film that are out of its line.

  Args:
    model: Poses and points; its pictures' names are in the film's order.
    database: Their features and verified matches.
    times: When each picture was taken [s].
  """
  images = registered(model)
  row = {image.image_id: k for k, image in enumerate(images)}
  votes = Votes(*np.zeros((2, len(images), len(images)), int))
  for ids, _, points in agreement.matched_points(model, database):
    first, second = sorted(row[key] for key in ids)
    sees = (points != 0).any(axis=1)
    votes.asked[first, second] = sees.sum()
    votes.agreed[first, second] = (sees & (points[:, 0] == points[:, 1])).sum()
  centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
  taken = np.array([times[image.name] for image in images])
  wrong, parts = np.zeros(len(images), bool), _parts(taken, votes, leaps(centers, taken))
  if parts.any():
    wrong = smaller_group(parts, overlap(model))
  rest = np.flatnonzero(~wrong)
  agreed, asked = (said[np.ix_(rest, rest)] for said in votes)
  leaping = leaps(centers[rest], taken[rest])
  wrong[rest] = out_of_line(taken[rest], Votes(agreed, asked), leaping)
  for image, is_wrong in zip(images, wrong, strict=True):
    if is_wrong:
      model.deregister_frame(image.frame_id)
  misled = set()
  agreeing = (votes.asked > 0) & (votes.agreed >= agreement.MAJORITY * votes.asked)
  for first, second in np.argwhere(agreeing):
    for own, other in ((first, second), (second, first)):
      if wrong[own] and not wrong[other]:
        misled.add((images[own].image_id, images[other].image_id))
  return OutOfLine(frozenset(images[k].name for k in np.flatnonzero(wrong)), frozenset(misled))


def gaps(out: Collection[str], placed: Collection[str], times: Mapping[str, float]) -> str:
  """Says which parts of a film were left out.

  Args:
    out: Pictures that were.
    placed: Pictures with a place, which part them.
    times: When each picture was taken [s], by names that are in the film's order.
  """
  parts, begins = list[list[float]](), True
  for name in sorted(times):
    if name in out:
      if begins:
        parts.append([])
      parts[-1].append(times[name])
    begins = name in placed or (begins and name not in out)
  words = [
    f"from {part[0]:.1f} s to {part[-1]:.1f} s" if len(part) > 1 else f"at {part[0]:.1f} s"
    for part in parts
  ]
  these = "that part" if len(parts) == 1 else "those parts"
  return (
    f"Pictures {', '.join(words)} stand apart from the rest of the film, or hang on it by little, "
    f"and were left out: film {these} again, slowly."
  )
