"""Tells places of a film that no hand gets to from where it was.

A hand goes on much as it moved the moment before, or after: where velocity leads a picture's place
is. Shapes: N pictures in the film's order.
"""

import numpy as np

_TIMES = 6.0  # the median change of velocity, chosen: at right places 4.6 times at most, where
# things alike deceive 10 and more
_USUAL = 0.9  # share of the steps from picture to picture that are as long as the film's usual one
# at most, chosen: a hand that is knocked changes its velocity, but goes no farther


def leaps(centers: np.ndarray, times: np.ndarray) -> np.ndarray:
  """Tells between which pictures a hand would have had to leap, bool [N, N], the earlier first.

  It leaps where its velocity is not that before nor that after, by far more than between most
  pictures as many apart, and it comes out farther off than a usual step is long.

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
    found[first, second] = (change > _TIMES * np.median(change)) & (nearest > usual)
  return found
