"""One effect felt by several joints: a payload on a body bends every joint on the way to it.

Each joint keeps the calibration that it had; the shared term is fitted to all of them at once.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.fitting import Fit, Problem
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection import decision, race
from nerf2real.sysid.selection.decision import Thresholds
from nerf2real.sysid.selection.joint import Found, decide
from nerf2real.sysid.selection.race import Entry
from nerf2real.sysid.selection.screening import Screened
from nerf2real.sysid.selection.wide import ancestors

Array = np.ndarray

_REFUTED = 0.1  # nats by which a joint that carries a payload may get worse; ours
_SUREST = 0.05  # of a value's typical size, that one joint's fit is sure of at most; ours


class SharedProblem(Problem):
  """Several joints with one shared term, each with a calibration of its own.

  Values are those of the shared term, then each joint's calibration.
  """

  def __init__(self, parts: Sequence[tuple[Problem, Term]]):
    """Takes each joint's problem and calibration."""
    self.parts = list(parts)
    self.plant = parts[0][0].plant

  def residuals(self, terms: Sequence[Term], xs: Array) -> Array:
    """Returns all joints' residuals [B, R]; the shared term is the first."""
    xs = np.atleast_2d(xs)
    count = len(terms[0].names)
    rows, at = [], count
    for (problem, _), calibration in zip(self.parts, terms[1:], strict=True):
      own = xs[:, at : at + len(calibration.names)]
      at += len(calibration.names)
      rows.append(problem.residuals((calibration, terms[0]), np.hstack([own, xs[:, :count]])))
    return np.hstack(rows)

  def simulate(self, terms: Sequence[Term], xs: Array):
    """Returns the first joint's motion."""
    xs = np.atleast_2d(xs)
    count, own = len(terms[0].names), len(terms[1].names)
    joined = np.hstack([xs[:, count : count + own], xs[:, :count]])
    return self.parts[0][0].simulate((terms[1], terms[0]), joined)

  def effort_scale(self, outputs) -> float:
    """Returns the first joint's scale."""
    return self.parts[0][0].effort_scale(outputs)

  def entries(self, fit: Fit) -> list[race.Entry]:
    """Returns each joint's entry under a shared fit."""
    shared, at = fit.terms[0], len(fit.terms[0].names)
    result = []
    for (problem, _), calibration in zip(self.parts, fit.terms[1:], strict=True):
      own = fit.x[at : at + len(calibration.names)]
      at += len(calibration.names)
      x = np.concatenate([own, fit.part(0)])
      result.append(race.entry(problem, Fit((calibration, shared), x, 0.0, 1.0, 0)))
    return result


def share(parts: Sequence[tuple[Problem, Term]], term: Term, start: Array) -> list[race.Entry]:
  """Fits a term to several joints at once and returns each one's entry.

  Args:
    parts: each joint's problem and calibration.
    term: what they share.
    start: values of the shared term.
  """
  problem = SharedProblem(parts)
  terms = [term, *[calibration for _, calibration in parts]]
  zeros = [np.array(c.starts[0], float) for _, c in parts]
  fit = problem.fit(terms, np.concatenate([start, *zeros]), evaluations=25)
  return problem.entries(fit)


def without_refuted(
  model: mujoco.MjModel,
  found: Sequence[Found],
  screened: Sequence[Screened],
  thresholds: Thresholds,
) -> None:
  """Drops payloads that make a joint which carries them worse, and decides anew."""
  for item in found:
    chosen = item.finding.chosen
    if not item.finding.named or "payload" not in decision.names(chosen):
      continue
    others = [s for s in screened if s.joint != item.joint]
    if _worse_with(model, item.joint, _as_known(item, chosen), others):
      item.ladder.singles = [e for e in item.ladder.singles if "payload" not in decision.names(e)]
      item.ladder.pairs = [e for e in item.ladder.pairs if "payload" not in decision.names(e)]
      item.finding = decide(item.ladder, item.thresholds)


def _as_known(item: Found, chosen: Entry) -> Term:
  """Returns a joint's payload with a prior as wide as that joint leaves each value open.

  One joint says nothing of how far along its axis a payload sits; those that carry it may.
  """
  index = [t.kind for t in chosen.fit.terms].index("payload")
  before = sum(len(t.names) for t in chosen.fit.terms[:index])
  term, x = chosen.fit.terms[index], chosen.fit.part(index)
  spread = np.sqrt(np.diag(intervals.covariance(item.ladder.problem, chosen.fit)))
  prior = np.maximum(spread[before : before + len(x)], _SUREST * np.array(term.scale))
  values = tuple(map(float, x))
  return dataclasses.replace(term, prior=tuple(map(float, prior)), centre=values, starts=(values,))


def _worse_with(
  model: mujoco.MjModel, joint: str, payload: Term, others: Sequence[Screened]
) -> list[str]:
  """Returns the joints that carry a payload on a joint's body and are explained worse with it."""
  carriers = ancestors(model, int(model.jnt_bodyid[model.joint(joint).id]))
  result = []
  for s in others:
    if s.joint in carriers:
      start = np.concatenate([s.null.fit.x, payload.starts[0]])
      fit = s.problem.fit([s.calibration, payload], start, evaluations=10)
      if race.entry(s.problem, fit).score - s.null.score > _REFUTED:
        result.append(s.joint)
  return result


def merge_payloads(model: mujoco.MjModel, found: Sequence[Found], thresholds: Thresholds) -> None:
  """Replaces payloads on several joints of one chain by one payload that all of them feel.

  A payload shows in every joint between it and the base. Each carrying body is tried with all
  raced joints that carry it; the one that explains most over all of them is kept. A joint keeps
  what was concluded of it alone unless the shared payload explains it as well.
  """
  carriers = [f for f in found if f.finding.named and _payload_entry(f, thresholds) is not None]
  if not carriers or model.njnt < 2:
    return
  by_joint = {f.joint: f for f in found}
  best: tuple[float, list[tuple[Found, Entry]]] | None = None
  for carrier in carriers:
    entry = _payload_entry(carrier, thresholds)
    assert entry is not None
    term = next(t for t in entry.fit.terms if t.kind == "payload")
    joint = model.joint(carrier.joint).id
    chain = ancestors(model, int(model.jnt_bodyid[joint]))
    items = [by_joint[j] for j in chain if j in by_joint]
    values = entry.fit.values("payload")
    start = np.array([values[n] for n in term.names])
    parts = [(f.ladder.problem, f.screened.calibration) for f in items]
    entries = share(parts, term, start)
    gain = sum(f.ladder.null.score - e.score for f, e in zip(items, entries, strict=True))
    first, own = entries[0], items[0]
    enough = own.ladder.null.score - first.score > thresholds.gain
    as_good = first.score - own.finding.chosen.score < thresholds.second
    if enough and as_good and (best is None or gain > best[0]):
      best = gain, list(zip(items, entries, strict=True))
  for rank, (item, entry) in enumerate(best[1] if best is not None else ()):
    own_entry = item.finding.chosen
    if rank == 0 or entry.score - own_entry.score < thresholds.second:
      left = not decision.adequate(entry, thresholds)
      item.finding = dataclasses.replace(
        item.finding,
        chosen=entry,
        named=rank == 0,
        verdict="unexplained" if left else ("effects" if rank == 0 else "none"),
      )


def _payload_entry(item: Found, thresholds: Thresholds) -> Entry | None:
  """Returns a joint's best hypothesis of a payload alone if it is nearly as good as the chosen."""
  entries = [e for e in item.ladder.singles if decision.names(e) == {"payload"}]
  if not entries or entries[0].score - item.finding.chosen.score > 2.5 * thresholds.second:
    return None
  return entries[0]
