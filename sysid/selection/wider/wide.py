"""Hypotheses of a body or of the whole machine, fitted to all joints that they concern.

Every hypothesis is screened over all its joints: from where its values and the joints' constants
cost least, two rounds of Gauss-Newton steps of the shared values with the constants following. What
the best of them is not clearly better than, with what its next step promises, is fitted to the end.
Shapes: B blocks, n shared values.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from nerf2real.sysid.fit import rough
from nerf2real.sysid.fit.layout import CLOCKS, Fit, Layout
from nerf2real.sysid.fit.likelihood import JointLikelihood
from nerf2real.sysid.fit.posterior import Fitter
from nerf2real.sysid.hypotheses.candidates import library
from nerf2real.sysid.hypotheses.plausible import plausible
from nerf2real.sysid.hypotheses.terms import WEAK, Term
from nerf2real.sysid.model.chains import along, ancestors
from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.selection.joints.subject import WHOLE, Subject
from nerf2real.sysid.selection.search.evidence import Scored, clearness
from nerf2real.sysid.selection.search.explain import scored_on

Array = np.ndarray

LATE = ("command_delay", "measurement_delay")
"""Kinds that are a joint's or the bus's."""
_OF_ALL = {"measurement_delay": (("of_all", 1.0),)}
"""What is fixed of a kind where it is the machine's: the motion that the other joints' readings
prescribe is late, too."""
ZERO = "encoder_offset"
"""Kind of one joint that those before and beyond it feel, which are where it is not read to be."""
_ENOUGH = 20  # steps of a fit, which ends by itself: a bound on time


@dataclasses.dataclass(frozen=True, eq=False)
class Wide:
  """An effect that several joints share, fitted."""

  term: Term
  members: tuple[Subject, ...]
  """The joints that it concerns."""
  fit: Fit

  @property
  def x(self) -> Array:
    """Its values [n]."""
    return self.fit.x[: len(self.term.names)]

  @property
  def key(self) -> tuple[str, str | None]:
    """What it claims: its kind and its body."""
    return self.term.kind, self.term.target

  def own(self, at: int) -> Array:
    """Returns the constants of one of the joints."""
    return self.fit.x[self.fit.layout.index[at]][: -len(self.x) or None]

  def evidence(self) -> "Evidence":
    """Returns the gain over the joints without it."""
    return _evidence(self.members, self.fit)

  def possible(self) -> "Evidence":
    """Returns the gain with what a further step promises: screened effects have not settled."""
    promised = Fitter([m.now for m in self.members], self.fit.layout).promised(self.fit)
    found = self.evidence()
    return dataclasses.replace(found, prior=found.prior - promised)


class Row(NamedTuple):
  """A joint under two hypotheses."""

  joint: JointLikelihood
  nats: Array
  """[B] by which the one is more likely than the other."""
  one: Array
  """[C, N] residuals of the one."""
  other: Array
  """[C, N] residuals of the other."""

  @classmethod
  def of(cls, best: Scored, other: Scored) -> "Row":
    """Returns two hypotheses of a joint under the scale of the first."""
    nats = [best.joint.loglik(s.fit.held[0]) for s in (best, other)]
    return cls(best.joint, nats[0] - nats[1], best.fit.residuals[0], other.fit.residuals[0])

  def turned(self) -> "Row":
    """Returns the other less the one."""
    return Row(self.joint, -self.nats, self.other, self.one)

  def less(self, row: "Row") -> "Row":
    """Returns the one less the one of another comparison with the same."""
    return Row(self.joint, self.nats - row.nats, self.one, row.one)


@dataclasses.dataclass(frozen=True)
class Evidence:
  """Two hypotheses over several joints, and what the priors take."""

  rows: dict[str, Row]
  prior: float = 0.0

  def __sub__(self, other: "Evidence") -> "Evidence":
    """Returns the difference to a comparison with the same; joints that one lacks are as there."""
    rows = dict(self.rows)
    for joint, row in other.rows.items():
      rows[joint] = rows[joint].less(row) if joint in rows else row.turned()
    return Evidence(rows, self.prior - other.prior)

  @property
  def total(self) -> float:
    """Nats in all."""
    return float(sum(row.nats.sum() for row in self.rows.values())) - self.prior

  @property
  def clear(self) -> float:
    """Standard errors from zero: joints are independent, so that their variances add."""
    rows = list(self.rows.values())
    expected = [row.joint.told_apart(row.one - row.other) for row in rows]
    return clearness([row.nats for row in rows], self.prior, expected)

  @property
  def by_logs(self) -> float:
    """The same of the logs alone, whatever the priors cost."""
    return dataclasses.replace(self, prior=0.0).clear


def hypotheses(
  model: mujoco.MjModel, subjects: Sequence[Subject]
) -> list[tuple[Term, tuple[Subject, ...]]]:
  """Returns the effects of bodies and of the machine that joints may share, with the joints."""
  result: list[tuple[Term, tuple[Subject, ...]]] = []
  everyone = tuple(subjects)
  machine: dict[tuple, Term] = {}
  for subject in subjects:
    plant = subject.now.plant
    terms = [plausible(t, plant) if plant.hinge else t for t in library(plant) if t.kind in WHOLE]
    # What the other joints' bridges draw was not measured: of a supply they share torque counts.
    terms = [t for t in terms if not dict(t.fixed).get("back_emf")]
    late = [_of_machine(t) for t in subject.library if t.kind in LATE]
    if len(late) == 1:  # a joint alone that holds no position does not tell these apart
      late.append(twin(late[0]))
    for term in (*terms, *late, *_of_supply(subject)):
      known = machine.get((term.kind, term.fixed))
      if known is None or term.scale < known.scale:  # of the joint that bears most
        machine[term.kind, term.fixed] = term
    for term in (t for t in subject.library if t.kind == "payload"):
      way = ancestors(model, str(term.target))
      members = tuple(s for s in subjects if s.joint in way)
      if len(members) > 1:
        result.append((term, members))
    chain = along(model, subject.joint)
    for term in (t for t in subject.library if t.kind == ZERO and chain[0] != subject.joint):
      members = tuple(s for s in subjects if s.joint in chain)
      if len(members) > 1:
        result.append((term, members))
  return [*((term, everyone) for term in machine.values()), *result]


def _of_machine(term: Term) -> Term:
  """Returns a late command or reading of a joint as one of all joints."""
  return dataclasses.replace(term, target=None, fixed=(*term.fixed, *_OF_ALL.get(term.kind, ())))


_VOLTAGES = (0.5, 0.7, 0.85, 0.95, 1.05, 1.2)  # of the reference's where searches start, chosen


def _of_supply(subject: Subject) -> list[Term]:
  """Returns the strength of all actuators at another voltage than a reference's.

  Torque at a duty goes with the voltage, and so does the largest; back-EMF takes what it took. What
  is declared of strength is a guess for each kind of actuator: without a reference none is shared.
  """
  if subject.before is None:
    return []
  limited = np.isfinite(subject.now.plant.declared[INDEX["highest"]])
  form = {"scales_limit": float(limited), "effort_tells": 1.0}
  return [
    dataclasses.replace(t, target=None, starts=tuple((v,) for v in _VOLTAGES))
    for t in subject.library
    if t.kind == WEAK and dict(t.fixed) == form
  ]


def twin(term: Term) -> Term:
  """Returns late readings of a machine for its late commands, and the reverse."""
  (other,) = (k for k in LATE if k != term.kind)
  fixed = tuple(f for f in term.fixed if f not in _OF_ALL.get(term.kind, ()))
  return dataclasses.replace(term, kind=other, fixed=(*fixed, *_OF_ALL.get(other, ())))


def screened(term: Term, members: Sequence[Subject]) -> Wide:
  """Returns an effect after two rounds of steps from its best start, the constants' derivatives
  taken over."""
  layout = Layout([m.explainer.null.terms for m in members], [term])
  joints = [m.now for m in members]
  begin = _begin(term, members)
  count = len(term.names)
  known = []
  for m in members:
    jacobian = m.explainer.null.fit.jacobian[0]
    known.append(np.concatenate([jacobian, np.zeros((count, *jacobian.shape[1:]))]))
  fresh = np.arange(layout.count) < count
  fit = Fitter(joints, layout).fit(begin, iterations=2, known=known, fresh=fresh)
  return Wide(term, tuple(members), fit)


def fitted(item: Wide) -> Wide:
  """Returns a screened effect fitted to the end, with its predictions of left-out blocks."""
  fitter = Fitter([m.now for m in item.members], item.fit.layout)
  fit = fitter.fit(item.fit, iterations=_ENOUGH)
  fit = rough.look_about(fitter, fit, rough.STAIRS, iterations=_ENOUGH)
  return dataclasses.replace(item, fit=fitter.leave_out(fit))


def resumed(term: Term, members: Sequence[Subject], x: Array) -> Wide:
  """Returns an effect fitted to the end from known values, beside what its joints have by now."""
  layout = Layout([m.known for m in members], [term])
  start = np.concatenate([x, *[m.explainer.null.fit.x for m in members]])
  fit = Fitter([m.now for m in members], layout).linearise(start)
  return fitted(Wide(term, tuple(members), fit))


def beside(item: Wide, other: Wide) -> float:
  """Returns the standard errors by which another effect is better with one beside it than alone."""
  joints = {m.joint: m for m in (*item.members, *other.members)}.values()
  before = [m.state for m in joints]
  held = dataclasses.replace(other.term.held_at(other.x), known=True)
  for member in other.members:  # with what they have of their own
    explainer, null = member.explainer, member.explainer.null
    explainer.null = scored_on(member.now, (*null.terms, held), null.fit.x, iterations=4)
  nulls = [m.explainer.null for m in item.members]
  fitter = Fitter([m.now for m in item.members], Layout([n.terms for n in nulls], [item.term]))
  fit = fitter.linearise(np.concatenate([item.x, *[n.fit.x for n in nulls]]))
  clear = fitted(dataclasses.replace(item, fit=fit)).evidence().clear
  for member, state in zip(joints, before, strict=True):
    member.state = state
  return clear


def _late(term: Term) -> list[int]:
  """Returns the indices of a term's delays."""
  return [at for at, name in enumerate(term.names) if name in CLOCKS]


def adopted(item: Wide, others: Sequence[Subject]) -> Wide:
  """Returns a fitted effect under the scale that it sets, under which joints are scored anew."""
  for member, residual in zip(item.members, item.fit.residuals, strict=True):
    member.now.rescale(residual)
  for subject in {m.joint: m for m in (*item.members, *others)}.values():
    explainer = subject.explainer
    explainer.null = explainer.refit(explainer.null, 4)
  return fitted(item)


def _begin(term: Term, members: Sequence[Subject]) -> Array:
  """Returns the start that costs least over all joints, each with its constants as they are or as
  they were before they were bent by what is missing."""
  starts = np.array(term.starts)
  if _late(term):  # held commands make stairs of a delay, whose derivatives mislead
    starts = np.arange(term.low[0], term.high[0], 0.5 * term.scale[0])[:, None]
  totals, owns = np.zeros(len(starts)), []
  for m in members:
    null = m.explainer.null
    values = (null.fit.values(t).values() for t in null.terms)
    before = [t.centre or tuple(v) for t, v in zip(null.terms, values, strict=True)]
    places = (null.fit.x, np.concatenate(before))
    tried = np.array([np.concatenate([own, s]) for s in starts for own in places])
    costs = Fitter([m.now], Layout([[*null.terms, term]])).costs(tried)
    costs = costs.reshape(len(starts), len(places))
    totals += costs.min(axis=1)
    owns.append([places[k] for k in costs.argmin(axis=1)])
  best = int(np.argmin(totals))
  return np.concatenate([starts[best], *[own[best] for own in owns]])


def alone(item: Wide, at: int) -> tuple[Evidence, Array]:
  """Returns the evidence of the same effect at one of its joints, fitted there alone, and its
  values [n]."""
  member = item.members[at]
  others = _OF_ALL.get(item.term.kind, ())
  term = dataclasses.replace(item.term, fixed=tuple(f for f in item.term.fixed if f not in others))
  fitter = Fitter([member.now], Layout([(*member.explainer.null.terms, term)]))
  fit = fitter.fit(np.concatenate([item.own(at), item.x]), iterations=_ENOUGH)
  return _evidence([member], fitter.leave_out(fit)), fit.x[-len(item.x) :]


def _evidence(members: Sequence[Subject], fit: Fit) -> Evidence:
  nulls = [m.explainer.null for m in members]
  squares = fit.held or [m.now.squares(r) for m, r in zip(members, fit.residuals, strict=True)]
  rows = {
    m.joint: Row(m.now, m.now.loglik(s) - null.nats, residual, null.fit.residuals[0])
    for m, s, residual, null in zip(members, squares, fit.residuals, nulls, strict=True)
  }
  prior = float(Fitter([m.now for m in members], fit.layout).prior(fit.x[None])[0])
  return Evidence(rows, prior - sum(n.prior for n in nulls))


def perfect(members: Sequence[Subject]) -> Evidence:
  """Returns what an effect of some joints would gain that left nothing there."""
  nulls = {m.joint: m.explainer.null for m in members}
  return Evidence(
    {
      joint: Row(
        null.joint, -null.nats, np.zeros_like(null.fit.residuals[0]), null.fit.residuals[0]
      )
      for joint, null in nulls.items()
    }
  )


def without(member: Subject, item: Scored, held: Term) -> Scored:
  """Returns a joint's hypothesis without one of its effects of wider scope, fitted on."""
  terms = tuple(t for t in item.terms if t != held)
  return scored_on(member.now, terms, item.fit.x, iterations=4)


def with_twin(member: Subject, item: Scored, held: Term, other: Term) -> bool:
  """Tells whether a joint's hypothesis with another effect of wider scope in the place of one
  predicts the same motion, but for a part of what remains."""
  terms = tuple(other if t == held else t for t in item.terms)
  fit = Fitter([member.now], Layout([terms])).fit(item.fit.x, iterations=4)
  return member.now.alike(fit.residuals[0] - item.fit.residuals[0])


def same(one: Wide, other: Wide) -> bool:
  """Tells whether two effects predict the same of all joints, but for a part of what remains; a
  joint that one does not concern is as without it."""
  joints = {m.joint: m for m in (*one.members, *other.members)}
  bare = {name: m.explainer.null.fit.residuals[0] for name, m in joints.items()}
  first, second = (
    bare | {m.joint: r for m, r in zip(w.members, w.fit.residuals, strict=True)}
    for w in (one, other)
  )
  return all(m.now.alike(first[name] - second[name]) for name, m in joints.items())
