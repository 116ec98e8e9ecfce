"""How far declared constants are off on all joints of a machine, which are of one batch.

What one joint alone leaves open (is it weaker, or are all its constants larger?) the others decide.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.selection import race
from nerf2real.sysid.selection.race import CLOCKS
from nerf2real.sysid.selection.screening import Screened

_FEWEST = 2  # joints of which one tells the latencies of the other; constants take three
_NARROWEST = 0.5  # of the prior's own spread; a joint may differ from its like
_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution, to its standard deviation


def expect_like_the_others(screened: Sequence[Screened]) -> None:
  """Centres every joint's constants and latencies on what the others have; fits the nulls anew."""
  if len(screened) < _FEWEST:
    return
  values = {s.joint: s.null.fit.values("calibration") for s in screened}
  for s in screened:
    alone = s.calibration
    centre, prior = [], []
    for name, spread in zip(alone.names, alone.prior, strict=True):
      others = [v[name] for joint, v in values.items() if joint != s.joint and name in v]
      middle = float(np.median(others)) if others else 0.0
      width = 1.5 * _TO_SIGMA * float(np.median(np.abs(np.array(others) - middle)))
      narrow = name not in CLOCKS and len(others) > 1
      centre.append(middle if narrow or name in CLOCKS else 0.0)
      prior.append(float(np.clip(width, _NARROWEST * spread, spread)) if narrow else spread)
    s.calibration = dataclasses.replace(
      alone, centre=tuple(centre), prior=tuple(prior), starts=(tuple(centre), *alone.starts)
    )
    s.null = race.entry(s.problem, s.problem.fit([s.calibration]))
