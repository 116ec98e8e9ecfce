"""Draws from fits with a richer friction, where more remains than names explain.

Fits of equal cost differ several times over on other motions, as where a joint stops hangs on small
differences of friction. Each is drawn as often as it is likely; the mean of all draws predicts
better than one fit.
"""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from nerf2real.sysid.fit.layout import CONSTANTS, Layout
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.candidates import typical_speed, typical_torque
from nerf2real.sysid.hypotheses.terms import FREE, STICKING, Term
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.selection.search.evidence import NAT, Scored, kinds_of
from nerf2real.sysid.selection.search.explain import Explainer

Array = np.ndarray

_FORMS = (0, 1, 2, 3, 4)
"""Which torque L loads the gear: `suite.effects.kinds.friction.LoadFriction`."""
_REPLACED = ("load_friction", "stribeck_friction", "supply_sag")
"""Kinds that imitate parts of it: strength that falls with torque is like friction that grows."""

_SLOWEST = 0.1
"""Of the fastest speed, most that the fall from rest to motion may take: the authors' published
fits of small servos have 0.07 to 0.11 rad/s; chosen, some times that."""
_EXPECTED = {"coefficient": 0.1, "rest": 0.5}
"""Spread about zero: what a motion does not show stays away; chosen."""
_MOST = 8  # fits that are fitted to the end, chosen
_FIRST = 3  # steps after which the best are chosen
_REFITTED = 3  # Jacobians at most of a fit
_ROUNDS = 3  # of fitting and setting the scale by the best
_DRAWS = 16  # chosen: a fit that is less likely than one in 32 is left out


def elaborated(
  explainer: Explainer, best: Scored, plain: Scored, named: Collection[str]
) -> list[Scored]:
  """Returns draws from the fits with richer friction and from what is simulated with without, the
  likeliest first; none where all are of that.

  Args:
    explainer: of the joint; its scale is set by the best fit, all is scored anew.
    best: the best hypothesis without, whose constants and names richer friction is added to.
    plain: what is simulated with without.
    named: kinds that every one must have.
  """
  joint = explainer.joint
  tried = sorted(_begun(explainer, best, named), key=lambda t: t[1].fit.cost)[:_MOST]
  for _ in range(_ROUNDS):
    for fitter, item in tried:
      item.fit = fitter.fit(item.fit, iterations=_REFITTED)
    tried.sort(key=lambda t: t[1].fit.cost)
    joint.rescale(tried[0][1].fit.residuals[0])
  for fitter, item in tried:
    item.fit = fitter.again(item.fit)
    item.nats = joint.loglik(fitter.leave_out(item.fit).held[0])
  explainer.rescore()
  plain.fit = dataclasses.replace(
    Fitter([joint], plain.fit.layout).again(plain.fit), held=plain.fit.held
  )
  drawn = _drawn([*(item for _, item in tried), plain])
  return drawn if any(item is not plain for item in drawn) else []


def _drawn(fits: Sequence[Scored]) -> list[Scored]:
  """Returns fits as often as they are likely by Akaike's weights (Burnham and Anderson 2002), by
  systematic resampling (Kitagawa 1996)."""
  fits = sorted(fits, key=_information)
  costs = np.array([_information(item) for item in fits])
  ends = np.cumsum(np.exp(costs[0] - costs))
  places = ends[-1] * (np.arange(_DRAWS) + 0.5) / _DRAWS
  return [fits[k] for k in np.searchsorted(ends, places)]


def _information(item: Scored) -> float:
  """Returns half of Akaike's criterion, nats."""
  return item.fit.cost + NAT * item.fit.layout.count


def _begun(
  explainer: Explainer, best: Scored, named: Collection[str]
) -> list[tuple[Fitter, Scored]]:
  """Returns every form from every start after a few steps, the derivatives of what it is added to
  taken over."""
  joint, tried = explainer.joint, []
  for terms, x in bases(explainer, best, named):
    known = Fitter([joint], Layout([terms])).linearise(x).jacobian[0]
    for carried in _FORMS:
      term = _rich_friction(joint.plant, carried)
      fitter = Fitter([joint], Layout([(*terms, term)]))
      blank = [np.concatenate([known, np.zeros((len(term.names), *known.shape[1:]))])]
      fresh = np.arange(len(x) + len(term.names)) >= len(x)
      for start in term.starts:
        begin = fitter.linearise(np.concatenate([x, start]), known=blank, fresh=fresh)
        fit = fitter.fit(begin, iterations=_FIRST, quick=True)
        tried.append((fitter, Scored(joint, (*terms, term), fit, np.zeros(0))))
  return tried


def bases(
  explainer: Explainer, best: Scored, named: Collection[str]
) -> list[tuple[tuple[Term, ...], Array]]:
  """Returns what richer friction is added to: the named effects on constants within tolerances, and
  on freed ones; a name that is theirs needs the freed ones."""
  gone = {FREE, STICKING, "load_friction", *(k for k in _REPLACED if k not in named)}
  kept = [
    t
    for t in best.terms
    if t.kind == CONSTANTS or (t.kind not in gone and (t.name is None or t.name in named))
  ]
  x = np.concatenate([list(best.fit.values(t).values()) for t in kept])
  own = {t.kind: t for t in explainer.base}
  tight = tuple(own.get(t.kind, t) if t.kind == CONSTANTS else t for t in kept)
  bases = [(tight, x)]
  if explainer.freed is not None:
    bases.append((tuple(explainer.freed if t.kind == CONSTANTS else t for t in kept), x))
  rich = {"load_friction"}
  return [(terms, x) for terms, x in bases if kinds_of(terms) | rich >= set(named)]


def _rich_friction(plant: JointPlant, carried: int) -> Term:
  """Returns the friction as a term.

  Args:
    plant: the joint.
    carried: which torque loads the gear.
  """
  fast, large = typical_speed(plant), typical_torque(plant)
  names = ("coefficient", "quadratic", "rest", "velocity")
  return Term(
    "load_friction",
    plant.joint,
    names,
    (0.0, 0.0, 0.0, 0.002 * fast),
    (0.8, 3.0 / large, 3.0, _SLOWEST * fast),
    (0.1, 0.2 / large, 0.2, 0.05 * fast),
    ((0.1, 0.3 / large, 0.4, 0.1 * fast), (0.05, 1.0 / large, 0.4, 0.03 * fast)),
    tuple(_EXPECTED.get(name, float("inf")) for name in names),
    (0.0,) * len(names),
    fixed=(("carried", float(carried)),),
  )
