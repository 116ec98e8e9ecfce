"""Damped Newton steps within bounds."""

import numpy as np

from nerf2real.sysid.fit.layout import Layout

Array = np.ndarray


def bounded(
  x: Array,
  h: Array,
  g: Array,
  layout: Layout,
  damping: float,
  share: float,
  moving: Array | None = None,
) -> Array:
  """Returns a damped Newton step from x, within bounds; values that press on one stay.

  Args:
    x: values [n].
    h: curvature [n, n].
    g: gradient [n].
    layout: bounds and scales.
    damping: of Marquardt's kind.
    share: of the step.
    moving: indices of the values that may move; all for None.
  """
  s = layout.scale
  free = ~(((x <= layout.low + 1e-9 * s) & (g > 0)) | ((x >= layout.high - 1e-9 * s) & (g < 0)))
  if moving is not None:
    free &= np.isin(np.arange(len(x)), moving)
  result = x.copy()
  if free.any():
    block = (h * s[:, None] * s)[np.ix_(free, free)]
    block = block + (1e-9 * np.trace(block) + 1e-9) * np.eye(len(block))
    block += damping * np.diag(np.diag(block))
    result[free] -= share * np.linalg.solve(block, (g * s)[free]) * s[free]
  return np.clip(result, layout.low, layout.high)
