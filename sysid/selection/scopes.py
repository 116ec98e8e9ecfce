"""Effects of a body or of the whole machine: one hypothesis, evidence summed over its joints.

Joints are fitted apart, but for the values that they share. An effect is of the wider scope where
the other joints' evidence, together with what the joint that shows it most loses by sharing its
values, is clearly for it.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.sysid.fit.posterior import Fitter, Layout, deviations
from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.explain import Scored, clear, standardised
from nerf2real.sysid.selection.subject import WHOLE, Subject
from nerf2real.sysid.settings import Settings

Array = np.ndarray

_LATE = ("command_delay", "measurement_delay")
"""Kinds that are a joint's or the bus's."""


@dataclasses.dataclass(frozen=True)
class Shared:
  """An effect that several joints share."""

  term: Term
  x: Array
  """Values [n]."""
  spread: Array
  """Their standard deviations [n]."""
  origin: Subject
  """The joint that it was found on."""
  members: tuple[Subject, ...]
  clear: float
  """Standard errors by which it is better than the same effect of one joint alone."""
  nats: float
  """What its joints gain together, priors included."""
  blocks: Array
  """[B] gain of blocks of time, joints added."""

  @property
  def held(self) -> Term:
    """The effect with its values, of which none is fitted."""
    return dataclasses.replace(self.term.held_at(self.x), known=True)


def shared_effects(
  model: mujoco.MjModel, subjects: Sequence[Subject], settings: Settings
) -> list[Shared]:
  """Finds effects of bodies and of the machine, puts them into their joints' hypotheses."""
  found: list[Shared] = []
  while len(found) < settings.depth:
    tried = _tried(model, subjects, {s.term.kind for s in found}, settings)
    best = max(tried, key=lambda s: s.nats, default=None)
    if best is None or best.clear < best.origin.beyond:
      break
    found.append(best)
    for subject in best.members:
      subject.take(best.held)
  return found


def ancestors(model: mujoco.MjModel, body: int) -> list[str]:
  """Returns the joints that carry a body, the nearest first."""
  result = []
  while body > 0:
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    result += [model.joint(first + i).name for i in range(count)][::-1]
    body = int(model.body_parentid[body])
  return result


def _tried(
  model: mujoco.MjModel, subjects: Sequence[Subject], known: set[str], settings: Settings
) -> list[Shared]:
  """Returns effects of wider scope that were fitted, from the joints that leave most."""
  found: dict[tuple[str, str | None], Shared] = {}
  for origin in sorted(subjects, key=lambda s: -s.left)[: settings.suspects]:
    explainer = origin.explainer
    names = explainer.library
    explainer.library = [*names, *_of_the_machine(origin)]
    singles = explainer.extend(explainer.null, settings.kept)
    explainer.library = names
    for single in singles:
      term = next(t for t in single.terms if t.name is not None)
      members = _members(model, term, subjects)
      if term.kind in known or len(members) < 2 or clear(single, explainer.null) < settings.worth:
        continue
      item = _fitted(origin, single, term, members)
      key = (term.kind, item.term.target)
      if key not in found or found[key].nats < item.nats:
        found[key] = item
    for single in singles:  # effects of the machine are no explanations of a joint
      if next(t for t in single.terms if t.name is not None).kind in WHOLE:
        explainer.scored.pop(single.terms, None)
  return list(found.values())


def _of_the_machine(origin: Subject) -> list[Term]:
  plant = origin.now.plant
  terms = [t for t in library(plant) if t.kind in WHOLE]
  return [plausible(t) for t in terms] if plant.hinge else terms


def _members(model: mujoco.MjModel, term: Term, subjects: Sequence[Subject]) -> list[Subject]:
  """Returns the joints that an effect concerns beyond the one that shows it."""
  if term.kind in (*WHOLE, *_LATE):
    return list(subjects)
  if term.kind != "payload":
    return []
  index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, str(term.target))
  carrying = ancestors(model, index) if index >= 0 else []
  return [s for s in subjects if s.joint in carrying]


def _fitted(origin: Subject, single: Scored, term: Term, members: Sequence[Subject]) -> Shared:
  """Returns an effect fitted to its joints together, from the values that one joint gives it."""
  whole = term if term.kind == "payload" else dataclasses.replace(term, target=None)
  start = np.array(list(single.fit.values(term).values()))
  own = [m.explainer.null.terms for m in members]
  layout = Layout(own, [whole])
  joints = [m.now for m in members]
  fitter = Fitter(joints, layout)
  x = np.concatenate([start, *[_begin(m, whole, start) for m in members]])
  fit = fitter.leave_out(fitter.fit(x, iterations=3))
  values = fit.x[: len(start)]
  nats = [j.loglik(h) for j, h in zip(joints, fit.held, strict=True)]
  without = [m.explainer.null.nats for m in members]
  gain = np.sum(nats, axis=0) - np.sum(without, axis=0)
  at = [m is origin for m in members].index(True)
  alone = single.nats - without[at]
  prior = float(fitter.prior(fit.x[None])[0])
  priors = [_prior(m.explainer.null) for m in members]
  total = float(gain.sum()) - prior + sum(priors)
  local = float(alone.sum()) - _prior(single) + priors[at]
  return Shared(
    whole,
    values,
    deviations(fit, joints)[: len(start)],
    origin,
    tuple(members),
    standardised(gain - alone, total - local, 1.0),
    total,
    gain,
  )


def _prior(item: Scored) -> float:
  """Returns what the priors of a hypothesis cost, nats."""
  return float(item.nats.sum()) - item.evidence


def _begin(member: Subject, term: Term, x: Array) -> Array:
  """Returns a joint's constants to begin with: as they are, or as they were before they were bent
  by what is missing."""
  null = member.explainer.null
  centre = np.concatenate([t.centre for t in null.terms])
  tried = np.array([np.concatenate([own, x]) for own in (null.fit.x, centre)])
  costs = Fitter([member.now], Layout([[*null.terms, term]])).costs(tried)
  return tried[int(np.argmin(costs)), : len(centre)]
