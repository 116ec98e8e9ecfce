"""Finds pictures that contradict all others as a group.

Where two things are alike, pictures of the one may be placed before the other, and agree with each
other and with those that are there. Their matches with the rest of what they see contradict. So
pictures are divided in two such that the area over which matches across agree, less the area over
which they contradict, is least. Where it is below zero more speaks against the two parts' places
than for them. It is a warning: things alike may outweigh the rest between parts that are right, too
(of twelve drawn rooms as photographs two wrong ones and one right one are told so).

Shapes: N pictures.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from nerf2real.scenes.colmap import pycolmap
from nerf2real.scenes.poses.checks.agreement import Evidence, evidence

_ASKED = 15  # matches of a pair that says something, as many as a place needs
_CONTRADICTS = 0.25  # share of them that agree below which a pair contradicts, chosen


class Areas(NamedTuple):
  """What pairs of pictures say of where the two were placed, symmetric."""

  ids: list[int]  # of the pictures [N]
  agreeing: np.ndarray  # cells of both pictures in which matches agree [N, N]
  against: np.ndarray  # cells in which they do not, of pairs that contradict [N, N]


def areas(said: dict[int, Evidence]) -> Areas:
  """Returns the areas of what matches say of all pairs of pictures, see `agreement.evidence`."""
  ids = sorted(said)
  row = {key: number for number, key in enumerate(ids)}
  agreeing, against = np.zeros((2, len(ids), len(ids)))
  for key, own in said.items():
    for other in np.unique(own.others):
      asked = own.others == other
      if asked.sum() < _ASKED or other not in row:
        continue
      agreed = len(np.unique(own.cells[own.features[asked & own.agrees]]))
      if own.agrees[asked].mean() < _CONTRADICTS:
        cells = len(np.unique(own.cells[own.features[asked]]))
        against[row[key], row[other]] = cells - agreed
      else:
        agreeing[row[key], row[other]] = agreed
  return Areas(ids, agreeing + agreeing.T, against + against.T)


def divide(weights: np.ndarray) -> np.ndarray | None:
  """Divides pictures in two with the least sum of weights across, if that is below zero.

  Args:
    weights: Of pairs, symmetric, zero on the diagonal [N, N].

  Returns:
    Whether each picture is in the smaller part, bool [N]; None where no division was found that is
    below zero. Each picture by itself is a start, from which pictures change sides one by one
    (Kernighan and Lin 1970).
  """
  count, best, found = len(weights), 0.0, None
  for start in range(count):
    side = np.where(np.arange(count) == start, 1.0, -1.0)
    pull = weights @ side  # of the own side less the other's, times the side
    while True:
      change = side * pull  # of the sum across where the picture changes its side
      small = np.flatnonzero(side == (1.0 if (side > 0).sum() <= (side < 0).sum() else -1.0))
      if len(small) == 1:
        change[small] = np.inf  # a part has a picture
      mover = int(np.argmin(change))
      if change[mover] >= 0:
        break
      side[mover] *= -1
      pull += 2 * side[mover] * weights[:, mover]
    across = float(weights[side > 0][:, side < 0].sum())
    if across < best:
      best, found = across, side
  if found is None:
    return None
  part: np.ndarray = found == (1.0 if (found > 0).sum() <= (found < 0).sum() else -1.0)
  return part


def contradicting_group(model: pycolmap.Reconstruction, database: Path) -> list[str]:
  """Names of the pictures that as a group contradict all others; empty without any.

  Args:
    model: Poses and points.
    database: Its features and verified matches.
  """
  found = areas(evidence(model, database))
  part = divide(found.agreeing - found.against)
  if part is None:
    return []
  return sorted(
    model.images[key].name for key, inside in zip(found.ids, part, strict=True) if inside
  )
