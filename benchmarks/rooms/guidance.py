"""Matches the pairs of a localisation anew: by descriptors, with guidance, and with COLMAP's.

  python benchmarks/rooms/guidance.py --database out/room/database.db

The database is copied, its features are kept. Guidance is what is added to matches by descriptors
alone; COLMAP's includes those.
"""

import contextlib
import dataclasses
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks import harness
from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.matching import features, guided
from nerf2real.scenes.poses.matching.features import FeatureSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which pairs are matched."""

  database: Path
  """A COLMAP database whose pairs were verified."""
  pairs: int = 100
  """So many of those that overlap, drawn from all."""
  seed: int = 0
  """Of the draw and of RANSAC."""


@contextlib.contextmanager
def _by_colmap() -> Iterator[None]:
  """Lets COLMAP guide its own matches."""
  plain = pycolmap.match_image_pairs

  def guiding(database: str, *, matching_options: Any, **named: Any) -> None:
    matching_options.guided_matching = True
    plain(database, matching_options=matching_options, **named)

  with mock.patch.object(pycolmap, "match_image_pairs", guiding):
    yield


def overlapping(database: Path) -> list[tuple[int, int]]:
  """Pairs of picture ids that have verified matches."""
  with pycolmap.Database.open(str(database)) as db:
    keys, geometries = db.read_two_view_geometries()
  rows = zip(keys, geometries, strict=True)
  found = [pycolmap.pair_id_to_image_pair(key) for key, g in rows if len(g.inlier_matches)]
  return sorted((min(pair), max(pair)) for pair in found)


def matches(database: Path, pairs: list[tuple[int, int]]) -> dict[tuple[int, int], set]:
  """Verified matches of pairs of picture ids."""
  with pycolmap.Database.open(str(database)) as db:
    rows = {pair: db.read_two_view_geometry(*pair).inlier_matches for pair in pairs}
  return {pair: set(map(tuple, found.tolist())) for pair, found in rows.items()}


def measure(settings: Settings, folder: Path) -> dict[str, harness.Value]:
  """Returns matches in all, those that both guidances find, and processor time a pair [ms]."""
  everything = overlapping(settings.database)
  random = np.random.default_rng(settings.seed)
  drawn = random.permutation(len(everything))[: settings.pairs]
  pairs = [everything[k] for k in sorted(drawn)]
  place = {number: k for k, number in enumerate(features.image_ids(settings.database).values())}
  indices = [(place[i], place[j]) for i, j in pairs]

  def run(name: str, *, by_colmap: bool = False) -> tuple[Path, float]:
    database = folder / f"{name}.db"
    shutil.copy(settings.database, database)
    with pycolmap.Database.open(str(database)) as db:
      db.clear_matches()
      db.clear_two_view_geometries()
    began = time.process_time()
    with _by_colmap() if by_colmap else contextlib.nullcontext():
      plain = FeatureSettings(guided_matching=False)
      features.match_pairs(database, indices, settings=plain, seed=settings.seed)
    return database, time.process_time() - began

  database, plain_s = run("ours")
  few = matches(database, pairs)
  guided.match_pairs(database, pairs[:1])  # compiles
  began = time.process_time()
  guided.match_pairs(database, pairs[1:])
  ours_s = time.process_time() - began
  ours = matches(database, pairs)
  database, theirs_s = run("theirs", by_colmap=True)
  theirs = matches(database, pairs)
  return {
    "pairs": len(pairs),
    "features": float(features.feature_counts(settings.database).mean()),
    "plain": sum(map(len, few.values())),
    "ours": sum(map(len, ours.values())),
    "theirs": sum(map(len, theirs.values())),
    "both": sum(len(ours[pair] & theirs[pair]) for pair in pairs),
    "plain_ms": 1e3 * plain_s / len(pairs),
    "ours_ms": 1e3 * ours_s / (len(pairs) - 1),
    "theirs_ms": 1e3 * (theirs_s - plain_s) / len(pairs),
  }


def main(settings: Settings) -> None:
  """Measures and prints the table."""
  with tempfile.TemporaryDirectory() as folder:
    figures = {settings.database.parent.name: measure(settings, Path(folder))}
  harness.finish("guidance", figures, settings, seed=settings.seed)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
