"""Shifted zeros as the other joints feel them.

A joint is judged beside the measured motion of the others. Where the zero of one is shifted, that
motion was misread: a link beyond it hangs elsewhere, which at the other joints looks like a zero, a
load or a tilt of their own. Where the zero of the joint is shifted that carries all others, the
machine moves as one that is tilted about that joint's axis, and no log tells the two apart.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.model.chains import along, carrying
from nerf2real.sysid.selection.joints import changes
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.wider.scopes import better
from nerf2real.sysid.selection.wider.wide import ZERO
from nerf2real.sysid.settings import Settings

Array = np.ndarray

TILT = "gravity_tilt"
_FIRST = 0  # the joint that carries all others, if one does: joints come from the root outwards
_LEVEL = 0.9  # cosine of how far an axis may be from level; about an upright one nothing is tilted


def reread(model: mujoco.MjModel, changed: Sequence[Changed], settings: Settings) -> list[Changed]:
  """Returns joints explained anew where the named zero of another changes what they feel.

  Zeros come in the order of the chain, as a joint feels those that carry it most. An explanation
  that is clearly worse beside the right motion stays.

  Args:
    model: the declared one.
    changed: the joints' explanations.
    settings: tolerances and effort.
  """
  result, done = {c.joint: c for c in changed}, set[str]()
  while shifted := [c for c in result.values() if ZERO in c.named and c.joint not in done]:
    first = min(shifted, key=lambda c: model.joint(c.joint).id)
    done.add(first.joint)
    best = first.found.best
    own = next(t for t in best.terms if t.kind == ZERO and not t.wider)  # others' are held there
    held = own.held_at(np.array([best.fit.values(own)[name] for name in own.names]))
    zero = dataclasses.replace(held, known=True)
    for joint in along(model, first.joint):
      if joint != first.joint and joint in result:
        result[joint] = _again(result[joint], zero, settings)
  return [result[c.joint] for c in changed]


def of_tilt(
  model: mujoco.MjModel, x: Array, bounds: Mapping[str, tuple[float, float]]
) -> tuple[str, float, tuple[float, float]] | None:
  """Returns the joint that carries all others, the offset of its zero that predicts what a tilt
  does, rad, and its interval; None where the tilt is not about that joint's axis.

  Args:
    model: the declared one.
    x: the tilt [2]: a rotation vector's part in the plane, rad.
    bounds: its interval by name.
  """
  along = _level_axis(model)
  if along is None:
    return None
  across = np.array([-along[1], along[0]])
  if abs(x @ across) > np.abs(across) @ _half(bounds):
    return None
  return model.joint(_FIRST).name, *part_of_tilt(model, x, bounds)


def part_of_tilt(
  model: mujoco.MjModel, x: Array, bounds: Mapping[str, tuple[float, float]]
) -> tuple[float, tuple[float, float]]:
  """Returns what `of_tilt` does but the joint, whatever a tilt is across that joint's axis.

  Raises:
    ValueError: the model has no joint of a level axis that carries all others.
  """
  along = _level_axis(model)
  if along is None:
    raise ValueError("Found no joint that carries all others, expected one of a level axis.")
  offset = float(x @ along / (along @ along))
  reach = float(np.abs(along) @ _half(bounds) / (along @ along))
  return offset, (offset - reach, offset + reach)


def _half(bounds: Mapping[str, tuple[float, float]]) -> Array:
  """Returns half the widths [2] of a tilt's intervals, rad."""
  return np.array([0.5 * np.ptp(bounds[name]) for name in ("x", "y")])


def _level_axis(model: mujoco.MjModel) -> Array | None:
  """Returns the axis [2] in the plane of the joint that carries all others; None without one."""
  if model.njnt == 0 or model.jnt_type[_FIRST] != mujoco.mjtJoint.mjJNT_HINGE:
    return None
  if not all(_FIRST in carrying(model, int(body)) for body in model.jnt_bodyid):
    return None
  if model.body_jntnum[model.jnt_bodyid[_FIRST]] != 1:
    return None
  data = mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)
  along = np.array(data.xaxis[_FIRST][:2])
  return along if float(along @ along) >= _LEVEL**2 else None


def _again(item: Changed, zero: Term, settings: Settings) -> Changed:
  """Returns a joint's explanation beside another's shifted zero, the old one where that changes
  nothing or is clearly worse."""
  subject, best = item.subject, item.found.best
  beside = subject.now.residuals((*best.terms, zero), best.fit.x[None])[0]
  if item.likelihood.alike(beside - best.fit.residuals[0]):
    return item
  before = subject.state
  subject.take(zero)
  again = changes.explain(subject, settings)
  comparable = again.likelihood.follows == item.likelihood.follows
  if comparable and better([item], [again]):
    subject.state = before
    return item
  return again
