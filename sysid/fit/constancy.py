"""Whether an effect is the same from the beginning of a log to its end.

A zero that creeps or a friction that warms is not what a shifted zero or a friction says of other
motions. An effect that grows along a straight line over each log is one value more; by the fit's
linearisation, all others following, that is a score test of constant parameters (Rao 1948).
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import Fit
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.hypotheses.terms import Term

Array = np.ndarray

_LEAST = 0.2
"""Share by which an effect grows that is another at a log's end; chosen between what right names
grow by (at most 0.06 in 29 blind sets) and the one zero that creeps among them (0.45)."""
_OF_TIME = ("thermal_derating", "supply_sag")  # kinds whose laws go with time


def is_constant(joints: Sequence[JointLikelihood], fit: Fit, term: Term, beyond: float) -> bool:
  """Tells whether an effect stays what it is, but for a fifth of itself, as far as logs show.

  Args:
    joints: what was fitted.
    fit: at its mode.
    term: the effect, one of its terms.
    beyond: standard errors that count as clear.
  """
  if term.freed or not term.names or term.kind in _OF_TIME:
    return True
  share, error = growth(joints, fit, term)
  return not (abs(share) > _LEAST and abs(share) > beyond * error)


def growth(joints: Sequence[JointLikelihood], fit: Fit, term: Term) -> tuple[float, float]:
  """Returns the share of itself by which an effect grows from the middle of a log to its end, and
  the standard error of that by the scatter of blocks.

  Args:
    joints: what was fitted.
    fit: at its mode.
    term: the effect, one of its terms.
  """
  fit, layout = intervals.central(fit, joints), fit.layout
  start, stop = layout.spans[layout.terms.index(term)]
  size = np.zeros(layout.count)
  nothing = {p.name: p.nominal for p in kind_of(term.kind).parameters if not p.shape}
  for at, name in zip(range(start, stop), term.names, strict=True):
    if np.isfinite(nothing.get(name, np.inf)):
      size[at] = fit.x[at] - nothing[name]
  count = layout.count + 1
  curvature = np.diag(np.append(layout.sigma**-2.0, 0.0))
  slope = np.append((fit.x - layout.centre) * layout.sigma**-2.0, 0.0)
  parts = []
  for joint, index, residual, jacobian in zip(
    joints, layout.index, fit.residuals, fit.jacobian, strict=True
  ):
    times = [log.time - log.time[0] for log in joint.plant.logs]
    along = np.concatenate([2.0 * t / max(t[-1], 1e-9) - 1.0 for t in times])
    rows = np.concatenate([jacobian, np.tensordot(size[index], jacobian, 1)[None] * along])
    places = np.append(index, layout.count)
    weighted = 2.0 * joint.weights(joint.squares(residual)) * rows
    curvature[np.ix_(places, places)] += np.einsum("icn,jcn->ij", weighted, rows)
    slope[places] += np.einsum("icn,cn->i", weighted, residual)
    parts.append((joint, places, residual, rows, weighted))
  inverse = np.linalg.pinv(curvature, rcond=1e-12)
  step = -inverse @ slope
  scatter = np.zeros((count, len(joints[0].starts)))
  for joint, places, residual, rows, weighted in parts:  # of what the step leaves
    left = weighted * (residual + np.tensordot(step[places], rows, 1))
    scatter[places] += np.add.reduceat(left, joint.starts, axis=-1).sum(axis=1)
  return float(step[-1]), float(np.linalg.norm(inverse[-1] @ scatter))
