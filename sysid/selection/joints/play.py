"""How far a healthy gear lets a joint lie beside where the same commands put it before.

A gear's teeth stay together while the torque that they pass to the link keeps its sign. Where it
changes, or there is none, the output may be anywhere in the gap: an arm on a vertical axis, one
that hangs straight down, one that a step of the command throws. Which way it goes, and how it
bounces, depends on microradians.
"""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from nerf2real.sysid.fit.expectation import NOISE
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.composition import compose
from nerf2real.sysid.hypotheses.constants import own_size
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.search.evidence import Scored

Array = np.ndarray

_CROSSED = 0.1
"""s in which a torque that presses takes the output through the gap, and after which it does not
bounce any more; chosen: a tenth of a block."""


def beside(joint: JointLikelihood, item: Scored) -> Array:
  """Returns mean squares of blocks [B] by which courses of two recordings may differ in the gap.

  It is no more than two draws of a place anywhere in it do, nor than twice what the reference's own
  readings were beside its model, which holds no gap.

  Args:
    joint: the logs, with what a reference left expected of them.
    item: a hypothesis.
  """
  gap = own_size(joint.plant, "backlash", "gap")
  if joint.expectation is None or not gap:
    return np.zeros(len(joint.starts))
  p = compose(joint.plant, item.terms, item.fit.x).p
  left = joint.squares(joint.expectation.under(p) * joint.gain)[0] - NOISE * joint.noise_squares
  squares = np.minimum(2.0 * np.clip(left, 0.0, None), 2.0 * gap**2 / 12.0)
  loose = np.concatenate([_loose(joint, item, i, gap) for i in range(len(joint.plant.logs))])
  share = np.add.reduceat(loose * joint.gain[0] ** 2, joint.starts) / joint.counts[0]
  return squares * share


def _loose(joint: JointLikelihood, item: Scored, index: int, gap: float) -> Array:
  """Tells where in a log [N] no torque keeps the teeth together."""
  c, log = compose(joint.plant, item.terms, item.fit.x), joint.plant.logs[index]
  inertia, here, across, at, bias = joint.plant.at_samples(
    c.loads, index, offset=c.p[INDEX["encoder_offset"]]
  )
  turned = np.nan_to_num(log.position - at)
  weight = here * np.cos(turned) + across * np.sin(turned)
  passed = (weight + bias) / inertia + log.acceleration  # torque over the link's inertia
  near = 2 * round(_CROSSED / float(np.median(np.diff(log.time)))) + 1
  lowest, highest = minimum_filter1d(passed, near), maximum_filter1d(passed, near)
  slowest = gap / (0.5 * _CROSSED**2)
  loose: Array = (lowest < slowest) & (highest > -slowest)
  return loose
