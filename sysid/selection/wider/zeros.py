"""Shifted zeros as the other joints feel them.

A joint is judged beside the measured motion of the others. Where the zero of one is shifted, that
motion was misread: a link beyond it hangs elsewhere, which at the other joints looks like a zero, a
load or a tilt of their own.
"""

import dataclasses
from collections.abc import Sequence

import mujoco

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.reduction import Reduction
from nerf2real.sysid.selection.joints import changes
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.joints.subject import beside
from nerf2real.sysid.selection.wider.scopes import better
from nerf2real.sysid.settings import Settings

KIND = "encoder_offset"


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
  while shifted := [c for c in result.values() if KIND in c.named and c.joint not in done]:
    first = min(shifted, key=lambda c: model.joint(c.joint).id)
    done.add(first.joint)
    offset = first.found.best.values(KIND)["offset"]
    kept: dict[int, Reduction] = {}  # joints share them
    for other in [c for c in result.values() if c is not first]:
      reductions = []
      for old in other.subject.now.plant.reductions:
        if id(old) not in kept:
          kept[id(old)] = Reduction(model, _without(old.log, first.joint, offset))
        reductions.append(kept[id(old)])
      result[other.joint] = _again(other, reductions, settings)
  return [result[c.joint] for c in changed]


def _without(log: Log, joint: str, offset: float) -> Log:
  """Returns a log whose readings of a joint lack an offset, rad."""
  assert log.states.position is not None
  position = log.states.position.copy()
  position[:, log.states.column(joint)] -= offset
  return dataclasses.replace(log, states=dataclasses.replace(log.states, position=position))


def _again(item: Changed, reductions: Sequence[Reduction], settings: Settings) -> Changed:
  """Returns a joint's explanation beside another motion of the others, the old one where that
  changes nothing or is clearly worse."""
  subject, best = beside(item.subject, reductions), item.found.best
  apart = subject.now.residuals(best.terms, best.fit.x[None])[0] - best.fit.residuals[0]
  if item.likelihood.alike(apart):
    return item
  again = changes.explain(subject, settings)
  comparable = again.likelihood.follows == item.likelihood.follows
  return item if comparable and better([item], [again]) else again
