"""Frees a model of photographs from pairs that match because two things are alike.

Two windows with one view, two beds with one cover: pictures of the one may be placed before the
other, and all that a mapper counts is as good there. Two things tell which pairs deceive: rotations
on which most of the matched area agrees (`rotations`), and what a group of pictures ought to have
in common with the others and has not (`division`, `overlap`). Both may err, so that a model that
was made without such pairs is taken only where its pictures see clearly more of what they ought to.
"""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks import rotations
from nerf2real.scenes.poses.checks.agreement import evidence
from nerf2real.scenes.poses.checks.division import divide
from nerf2real.scenes.poses.checks.overlap import CLEAR, Overlap, overlap

_HOLDS = 0.25  # share of a pair's matches that agree with its places, from which on it holds them


class Found(NamedTuple):
  """A model, and how it came about."""

  model: pycolmap.Reconstruction
  mapper: str
  apart: float  # how far attempts are apart, see `attempts`


def undeceived(
  found: Found,
  database: Path,
  map_again: Callable[[Path], tuple[pycolmap.Reconstruction | None, str, float]],
  *,
  seed: int,
) -> Found:
  """Maps pictures anew without pairs of things alike, as long as that is clearly better.

  Args:
    found: A model by all pairs.
    database: Its features and verified matches.
    map_again: Makes what `Found` holds from another database, None for a model where it has none.
    seed: Of the random choices.
  """
  seen, without = overlap(found.model), frozenset[tuple[int, int]]()
  tried = {without}
  for pairs_of in (_turning, _holding, _holding):
    pairs = without | pairs_of(found.model, seen, database, seed)
    if pairs in tried:
      continue
    tried.add(pairs)
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
      copy = Path(shutil.copyfile(database, Path(folder) / "database.db"))
      with pycolmap.Database.open(str(copy)) as db:
        for pair in pairs:
          db.delete_two_view_geometry(*pair)
      model, mapper, apart = map_again(copy)
    if model is None:
      continue
    sees = overlap(model)
    if sees.balance - seen.balance > CLEAR * abs(seen.balance):
      found = Found(model, f"{mapper}, without {len(pairs)} pairs of things alike", apart)
      seen, without = sees, pairs
  return found


def doubtful(model: pycolmap.Reconstruction) -> list[str]:
  """Names of the pictures that as a group lack what they ought to see; empty without any."""
  return sorted(model.images[key].name for key in _group(overlap(model)))


def _group(seen: Overlap) -> set[int]:
  """Ids of the pictures that as a group clearly lack what they ought to see."""
  weights = seen.common - seen.missing
  part = divide(weights)
  if part is None or weights[part][:, ~part].sum() > -CLEAR * abs(weights.sum()) / 2:
    return set()
  return set(np.array(seen.ids)[part].tolist())


def _turning(
  model: pycolmap.Reconstruction, _: Overlap, database: Path, seed: int
) -> set[tuple[int, int]]:
  """Pairs, by ids, that contradict most of the matched area's rotations, where the model does."""
  pairs = rotations.relative_rotations(database, next(iter(model.cameras.values())), seed=seed)
  against = rotations.contradiction(model, pairs, rotations.consensus(pairs, seed=seed))
  return set() if against is None else against.refuted


def _holding(
  model: pycolmap.Reconstruction, seen: Overlap, database: Path, _: int
) -> set[tuple[int, int]]:
  """Pairs, by ids, that hold a group at its place which lacks what it ought to see there."""
  group, pairs = _group(seen), set()
  if group:
    for key, said in evidence(model, database).items():
      for other in np.unique(said.others).tolist():
        agrees = said.agrees[said.others == other].mean() >= _HOLDS
        if (key in group) != (other in group) and agrees:
          pairs.add((min(key, other), max(key, other)))
  return pairs
