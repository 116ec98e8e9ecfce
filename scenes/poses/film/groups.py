"""Tells two groups of a film's parts that stand in two worlds.

Before things alike (two windows, two walls with the same chairs) every other part of a film may
stand at another place, so that half of it does: each is whole, and contradicts what comes before
and after it. Which of them belong together what they ought to see of each other tells, whenever
they were filmed, see `overlap`. Single pictures do not tell it: blurred ones have little in common.
Shapes: N pictures in the film's order.
"""

import numpy as np

from nerf2real.scenes.poses.checks.division import divide
from nerf2real.scenes.poses.checks.overlap import CLEAR, Overlap


def smaller_group(parts: np.ndarray, seen: Overlap) -> np.ndarray:
  """Tells which pictures are of the smaller of two groups that clearly lack each other, bool [N].

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
