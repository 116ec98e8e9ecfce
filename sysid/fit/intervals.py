"""How sure the values of a fit are: a sandwich estimate that allows for correlated residuals.

The sandwich is `covariance`. It is widened by a systematic share: a model that is
slightly wrong moves its values by more than noise does. Priors count with the spread that they
state: a friction that was added cannot be known better than the damping that was declared. So do
bounds: a late command can only be later by what another latency is less, and that is not below
zero. Shapes: n values, k values of a term.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerf2real.sysid.fit.layout import Fit
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.candidates import typical_speed
from nerf2real.sysid.hypotheses.terms import FREE, Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

SYSTEMATIC = 2.0  # factor on standard deviations; ours, set on blind sets to cover 95 %
RELATIVE = 0.009  # of a value; what no model of a joint holds: elastic gears, uneven teeth; ours
BESIDE_PLAY = 0.025  # the same where a course does not repeat; ours
PEAK = 0.08
"""Of all dry friction: it is larger at rest, over a way no rigid model has; ours."""
LATE = 6e-4  # s of a delay; firmware and bus work in cycles of a millisecond; ours
_TOLERANCES = dict(SETTINGS.tolerances)
OWN_LATENCY = 2.0 * _TOLERANCES["latency"]  # s; what a healthy machine may have of a delay
RUBS = _TOLERANCES["friction"]  # of the declared dry friction, by which servos of a batch differ
_DRY = ("torque", "positive", "negative")  # dry friction that is added to the declared one
_PLAY = {"gap": (0.85, 1.35), "stiffness": (0.4, 2.5), "damping": (0.4, 2.5)}
"""Times a value of play, the least of an interval: gears that give way take a part of the gap, and
costs are too rough for derivatives to say how sure values are. Ours, on blind sets."""
_RESOLVED = 1e-4
"""Of a curvature scaled to 1 for each value: twins whose derivatives agree to a hundredth have
less."""
_DRAWS, _FEW = 4000, 200  # of the normal distribution, and least that must be within bounds
_AGAIN = 20  # times at most that draws beyond a bound are taken anew
_EDGE = 1e-6  # scales by which a value may be beyond its bound
_MOVED = 3.0  # standard deviations by which a value is moved beside all others, for derivatives
_MOST = 0.2  # of a value's scale, of those steps


def intervals(
  joint: JointLikelihood, fit: Fit, term: Term, *, own_latency: bool
) -> dict[str, tuple[float, float]]:
  """Returns 95 % intervals of the values of a term of a fit; see `around`."""
  span = fit.layout.spans[fit.layout.terms.index(term)]
  return around(
    term,
    fit.x[slice(*span)],
    *reaches(fit, spread(fit, [joint]), span),
    own_latency=own_latency,
    usual=usual_of(joint, fit),
    relative=BESIDE_PLAY if any(t.kind == "backlash" for t in fit.layout.terms) else RELATIVE,
  )


class Usual(NamedTuple):
  """What every machine of a kind has of some effects, beside its declared constants."""

  friction: float = 0.0
  """Declared dry friction, N m or N."""
  dry: float = 0.0
  """The same with what a fit adds to it."""
  bend: float = 0.0
  """Drag, N m s^2/rad^2 or N s^2/m^2, by which the declared damping bends over the speeds of the
  logs where it is off at the top by as much as the constant may be."""


_NOTHING = Usual()


def usual_of(joint: JointLikelihood, fit: Fit) -> Usual:
  """Returns what machines of a joint's kind have."""
  p = joint.plant.declared
  rubs = float(p[INDEX["friction"]])
  dry = rubs
  for term in fit.layout.terms:
    if term.kind in ("coulomb_friction", "asymmetric_friction") and term.names:
      dry += float(np.mean(list(fit.values(term).values())))
  share = dict(joint.settings.tolerances)["damping"]
  return Usual(rubs, dry, share * float(p[INDEX["damping"]]) / typical_speed(joint.plant))


def unmodelled(
  term: Term, name: str, value: float, *, usual: Usual = _NOTHING, relative: float = RELATIVE
) -> float:
  """Returns the standard deviation of a value by what no model of the joint holds; see `around`."""
  own = 1.0 + value if term.kind == "calibration" else value  # a factor is told
  if name == "breakaway":
    return PEAK * (usual.dry + value)
  known = LATE if name == "delay" else 0.0
  known = RUBS * usual.friction if name in _DRY and term.kind != "calibration" else known
  known = usual.bend if term.kind == "quadratic_drag" else known
  return float(np.hypot(relative * own, known))


def draws(joint: JointLikelihood, fit: Fit, count: int, random: np.random.Generator) -> Array:
  """Returns joint draws [count, n] of a fit's values, within their bounds.

  Of the normal distribution whose ends intervals are: what goes together in the fit does in the
  draws; what no model holds is independent. Draws beyond a bound are taken anew, and at the last
  put on it.
  """
  layout, own = fit.layout, np.zeros(len(fit.x))
  usual = usual_of(joint, fit)
  for term, (a, b) in zip(layout.terms, layout.spans, strict=True):
    if term.kind == FREE:
      continue
    for at, name in zip(range(a, b), term.names, strict=True):
      share = 0.0 if name in ("zero", "skew", "latency") else RELATIVE
      own[at] = unmodelled(term, name, fit.x[at], usual=usual, relative=share)
  wide = spread(fit, [joint]) + np.diag(own**2)
  result = random.multivariate_normal(fit.x, wide, count, check_valid="ignore", method="eigh")
  for _ in range(_AGAIN):
    out = ((result < layout.low) | (result > layout.high)).any(axis=1)
    if not out.any():
      break
    result[out] = random.multivariate_normal(
      fit.x, wide, int(out.sum()), check_valid="ignore", method="eigh"
    )
  return np.clip(result, layout.low, layout.high)


def reaches(fit: Fit, covariance: Array, span: tuple[int, int]) -> tuple[Array, Array]:
  """Returns how far values [k] may be below and above a fit's, all others within their bounds.

  Ends of 95 % of a normal distribution that is cut off where other values have their bounds.

  Args:
    fit: the values.
    covariance: of all [n, n].
    span: which ones.
  """
  own = slice(*span)
  half = SETTINGS.sigmas * np.sqrt(np.maximum(np.diag(covariance)[own], 0.0))
  random = np.random.default_rng(0)
  draws = random.multivariate_normal(fit.x, covariance, _DRAWS, check_valid="ignore", method="eigh")
  others = np.ones(len(fit.x), bool)
  others[own] = False
  inside = (draws >= fit.layout.low - _EDGE * fit.layout.scale) & (
    draws <= fit.layout.high + _EDGE * fit.layout.scale
  )
  kept = draws[inside[:, others].all(axis=1)]
  if not _DRAWS > len(kept) > _FEW:
    return half, half
  low, high = np.quantile(kept[:, own], (0.025, 0.975), axis=0)
  return np.minimum(np.maximum(fit.x[own] - low, 0.0), half), np.minimum(
    np.maximum(high - fit.x[own], 0.0), half
  )


def spread(fit: Fit, joints: Sequence[JointLikelihood]) -> Array:
  """Returns the covariance [n, n] of a fit's values, widened by the systematic share.

  A fit keeps it as long as the joints' scales stay.
  """
  scale = b"".join(j.scale.tobytes() + j.observations.tobytes() for j in joints)
  if fit.spread is None or fit.spread[0] != scale:
    fit.spread = scale, covariance(central(fit, joints), joints, systematic=SYSTEMATIC)
  return fit.spread[1]


def covariance(fit: Fit, joints: Sequence[JointLikelihood], *, systematic: float = 1.0) -> Array:
  """Returns the covariance [n, n] of a fit's values, by the gradient's scatter over blocks.

  H^-1 (sum over blocks of g g') H^-1, which holds where residuals go together (White 1980, in
  blocks as Liang and Zeger 1986); blocks of different joints at the same time are added. Means of
  priors that a reference has left open are as any other reading: their scatter counts, by what they
  pull.

  Args:
    fit: at its mode.
    joints: what was fitted.
    systematic: factor on the scatter of blocks; priors count with the spread that they state.
  """
  scores = np.zeros((len(joints[0].starts), fit.layout.count))
  for joint, index, residual, jacobian in zip(
    joints, fit.layout.index, fit.residuals, fit.jacobian, strict=True
  ):
    weighted = 2.0 * joint.weights(joint.squares(residual)) * residual * jacobian
    scores[:, index] += np.add.reduceat(weighted, joint.starts, axis=-1).sum(axis=1).T
  inverse = np.linalg.pinv(fit.precision, rcond=1e-12)
  pull = fit.layout.sigma**-2.0
  prior = np.diag(pull) + pull * fit.layout.open * pull[:, None]
  return inverse @ (systematic**2 * scores.T @ scores + prior) @ inverse


def central(fit: Fit, joints: Sequence[JointLikelihood]) -> Fit:
  """Returns a fit linearised by central differences.

  Where two values do the same (damping and added friction), their derivatives must agree to a part
  in a thousand, or the difference looks like information: friction makes courses rough, so that
  each value is moved by what moves the course as much.
  """
  fitter, scale = Fitter(joints, fit.layout), fit.layout.scale
  told = np.diag(fit.curvature.sum(axis=0)) * scale**2
  width = np.minimum(_MOVED / np.sqrt(np.maximum(told, 1e-300)), _MOST)
  sides = [fitter.linearise(fit.x, side, residuals=fit.residuals) for side in (width, -width)]
  jacobians, curvature = [], np.zeros((fit.layout.count, fit.layout.count))
  for joint, index, residual, *both in zip(
    joints, fit.layout.index, fit.residuals, *[side.jacobian for side in sides], strict=True
  ):
    mean = np.mean(both, axis=0)
    weights = 2.0 * joint.weights(joint.squares(residual))
    resolved = _resolved(np.einsum("icn,jcn->ij", weights * mean, mean))
    jacobians.append(np.tensordot(resolved, mean, 1))
    part = np.einsum("icn,jcn->ij", weights * jacobians[-1], jacobians[-1])
    curvature[np.ix_(index, index)] += part
  return dataclasses.replace(sides[0], jacobian=jacobians, curvature=curvature[None])


def _resolved(curvature: Array) -> Array:
  """Returns what takes the directions out of a Jacobian [n, n] that finite differences cannot tell
  from flat ones: neither curvature nor scatter is known along them."""
  size = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
  values, vectors = np.linalg.eigh(curvature / size / size[:, None])
  kept = vectors * (values > _RESOLVED)
  return kept @ vectors.T / size * size[:, None]


def around(
  term: Term,
  x: Array,
  down: Array,
  up: Array,
  *,
  own_latency: bool = False,
  usual: Usual = _NOTHING,
  relative: float = RELATIVE,
) -> dict[str, tuple[float, float]]:
  """Returns 95 % intervals about values of a term.

  Args:
    term: the effect.
    x: its values [k].
    down: how far the values may be below [k].
    up: the same above.
    own_latency: whether nothing tells what latency the machine had before: then a delay is all
      that it has now, and its interval reaches down by what healthy machines have.
    usual: what every machine of the kind has of some effects.
    relative: share of a value that no model of the joint holds.
  """
  result = {}
  for name, value, less, more, lowest in zip(term.names, x, down, up, term.low, strict=True):
    model = SETTINGS.sigmas * unmodelled(term, name, value, usual=usual, relative=relative)
    below = OWN_LATENCY if name == "delay" and own_latency else 0.0
    low = max(value - float(np.hypot(less, model)) - below, lowest)
    high = value + float(np.hypot(more, model))
    if term.kind == "backlash":
      low, high = min(low, _PLAY[name][0] * value), max(high, _PLAY[name][1] * value)
    result[name] = (float(low), float(high))
  return result
