"""Divides pictures in two parts that have least to do with each other.

Shapes: N pictures.
"""

import numpy as np


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
