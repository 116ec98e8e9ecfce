"""Where the search for one effect more begins: what a parent's fit, which lacks it, makes of it.

A fit without an effect bends its constants until they do what is missing, and descents do not lead
back from there. So they begin at the parent's own motion, or nearly that, told with the effect. S
starts of n values.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.suite.effects import kind_of
from nerf2real.sysid.fit import signatures
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses.terms import COGGING, WEAK, Term
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.plant import JointPlant
from nerf2real.sysid.selection.search.evidence import Scored

Array = np.ndarray

_TWINS = {
  "command_delay": "latency",
  "measurement_delay": "skew",
  "encoder_offset": "zero",
  "coulomb_friction": "friction",
  "asymmetric_friction": "friction",
  "viscous_friction": "damping",
  "payload": "mass",
}
"""Effects that do what a constant does, and that constant."""
_SHARES = ("friction", "damping")  # constants in units of what is declared, as the kernel has it
_LOADS = ("damping", "armature", "friction", "mass")
"""Constants that are all larger by one share where a motor is weaker by it."""


def beginnings(parent: Scored, term: Term) -> Array:
  """Returns where a parent's hypothesis with one effect more begins [S, n].

  Args:
    parent: fitted without it.
    term: the effect.
  """
  own = [np.concatenate([parent.fit.x, s]) for s in (*term.starts, *_waves(parent, term))]
  own += [*_handed_over(parent, term), *_in_common(parent, term), *_scaled(parent, term)]
  return _moved((*parent.terms, term), np.array(own))


def _handed_over(parent: Scored, term: Term) -> list[Array]:
  """Returns where a parent's fit is with what a constant is off by as its twin's values, if it has
  one: the same simulation, and a constant as it was known."""
  constants = next((t for t in parent.terms if t.kind == CONSTANTS), None)
  name = _TWINS.get(term.kind)
  if constants is None or name not in constants.names:
    return []
  at = parent.fit.layout.spans[parent.fit.layout.terms.index(constants)][0]
  at += constants.names.index(name)
  off = float(parent.fit.x[at] - parent.fit.layout.centre[at])
  plant = parent.joint.plant
  if term.kind == "payload":
    unit, place = _carried(plant)
    values = np.clip([unit * off, *place], term.low, term.high)
    handed = float(values[0]) / unit
  else:
    unit = float(plant.declared[INDEX[name]]) if name in _SHARES else 1.0
    if not unit:  # a share of nothing
      return []
    values = np.clip(unit * off, term.low, term.high)
    handed = float(values.mean()) / unit
  if not handed:
    return []
  x = np.concatenate([parent.fit.x, values])
  x[at] -= handed
  return [x]


def _carried(plant: JointPlant) -> tuple[float, Array]:
  """Returns the mass that a joint carries, kg, and where in its body that is at the model's
  reference pose, m [3]."""
  model, data = plant.model, mujoco.MjData(plant.model)
  mujoco.mj_kinematics(model, data)
  mujoco.mj_comPos(model, data)
  body = int(model.jnt_bodyid[model.joint(plant.joint).id])
  place = data.xmat[body].reshape(3, 3).T @ (data.subtree_com[body] - data.xpos[body])
  return max(float(model.body_subtreemass[body]), 1e-9), place


def _in_common(parent: Scored, term: Term) -> list[Array]:
  """Returns where constants are without what they are off by in common, and that as a gain: about
  the same motion, at constants nearer to those that are known. Where constants have taken a motor's
  weakness single steps do not lead there. Beside an effect there are none, as its torques are open.
  """
  constants = parent.terms[0]
  if term.kind != WEAK or constants.kind != CONSTANTS or parent.names:
    return []
  names = zip(constants.names, constants.prior, strict=True)
  at = [i for i, (name, sigma) in enumerate(names) if name in _LOADS and np.isfinite(sigma)]
  if not at:
    return []
  x, layout = parent.fit.x.copy(), parent.fit.layout
  here, known, weight = 1.0 + x[at], 1.0 + layout.centre[at], layout.sigma[at] ** -2.0
  gain = float(np.clip(weight @ (here * known) / (weight @ here**2), term.low[0], term.high[0]))
  x[at] = gain * here - 1.0
  return [np.append(x, gain)]


def _scaled(parent: Scored, term: Term) -> list[Array]:
  """Returns where a parent's fit is with all torques of its effects larger by each start of a gain:
  that makes about the same motion, and single steps do not lead from one to the other."""
  if term.kind != WEAK:
    return []
  torques = np.array(
    [
      t.kind != CONSTANTS and kind_of(t.kind).parameter(n).unit.startswith("N m")
      for t in parent.terms
      for n in t.names
    ]
  )
  if not torques.any():
    return []
  factors = np.array([s[0] for s in term.starts])[:, None]
  return list(np.hstack([parent.fit.x * np.where(torques, factors, 1.0), factors]))


def _waves(parent: Scored, term: Term) -> list[tuple[float, ...]]:
  """Returns where torque repeats with position under a hypothesis, if that is what a term says:
  what else is missing hides it in what the declared model leaves."""
  if term.kind != COGGING or not parent.names:
    return []
  return [
    tuple(np.clip(wave, term.low, term.high))
    for wave in signatures.waves(parent.joint.plant, parent.terms, parent.fit.x)
  ]


def _moved(terms: Sequence[Term], begin: Array) -> Array:
  """Returns starts [S, n], and where an encoder's zero and cogging are among the effects those with
  its phase moved by the zero: either was found over positions as they were read."""
  at = {(t.kind, n): i for i, (t, n) in enumerate((t, n) for t in terms for n in t.names)}
  zero = at.get(("encoder_offset", "offset"))
  if zero is None or (COGGING, "phase") not in at:
    return begin
  moved, phase = begin.copy(), at[COGGING, "phase"]
  turned = moved[:, phase] + moved[:, at[COGGING, "periods"]] * moved[:, zero]
  moved[:, phase] = np.angle(np.exp(1j * turned))
  return np.vstack([begin, moved])
