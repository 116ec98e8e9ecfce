"""What is claimed: findings as entries of a report, and as effects that can be simulated."""

from typing import Any

import numpy as np

from nerf2real.suite.effects import Effect, kind_of
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection import decision
from nerf2real.sysid.selection.joint import Found
from nerf2real.sysid.selection.race import Entry
from nerf2real.sysid.selection.screening import Screened
from nerf2real.sysid.selection.subject import WHOLE

Claim = tuple[Effect, dict[str, Any]]
"""An effect and its entry in the report."""

Array = np.ndarray

_NOTHING = 1e-9  # of a size


def effect(item: Found, entry: Entry, term: Term, held_out: float) -> Claim:
  """Returns a joint's effect, with intervals.

  Args:
    item: the joint.
    entry: its hypothesis, fitted to the end.
    term: the effect.
    held_out: nats that the hypothesis gains over the constants alone on left-out blocks.
  """
  problem = item.ladder.problem
  bounds = intervals.intervals(problem, entry.fit, term.kind)
  found = term.effect(entry.fit.part(entry.fit.terms.index(term)), bounds)
  row = {
    "kind": term.kind,
    "joint": None if term.kind in WHOLE else item.joint,
    **({"body": term.target} if term.kind == "payload" else {}),
    "parameters": _parameters(found, bounds, term, slide=not problem.plant.hinge),
    "evidence": {
      **decision.evidence(entry, item.ladder),
      "runner_up_behind_nats": _runner_up(item),
      "chance_gain_q95_nats": round(item.chance["q95"], 4),
      "held_out_gain_nats": round(held_out, 4),
    },
  }
  return found, row


def is_idle(entry: Entry, term: Term) -> bool:
  """Tells whether an effect of a hypothesis has the sizes that do nothing."""
  sizes = [p for p in kind_of(term.kind).parameters if p.name in term.names and not p.shape]
  values = entry.fit.values(term.kind)
  return bool(sizes) and all(abs(values[p.name] - p.nominal) < _NOTHING for p in sizes)


def shared(
  term: Term, x: Array, bounds: dict[str, tuple[float, float]], evidence: dict[str, Any]
) -> Claim:
  """Returns an effect of several joints.

  Args:
    term: the effect.
    x: its values [n].
    bounds: their intervals.
    evidence: for the report.
  """
  found = term.effect(x, bounds)
  parameters = _parameters(found, bounds, term, slide=False)
  return found, {
    "kind": found.kind,
    "joint": None,
    "parameters": parameters,
    "evidence": evidence,
  }


def constants(s: Screened, entry: Entry) -> dict[str, Any]:
  """Returns the report's entry of declared constants that are off."""
  term = entry.fit.terms[0]
  found = term.effect(entry.fit.part(0), intervals.intervals(s.problem, entry.fit, "calibration"))
  return {
    "kind": "parameter_error",
    "joint": s.joint,
    "parameters": _parameters(found, found.intervals, term, slide=False),
    "evidence": {"gain_over_declared_nats": round(float(s.declared.score - s.null.score), 4)},
  }


def constants_of_all(claimed: list[dict[str, Any]]) -> dict[str, Any]:
  """Returns one entry for constants that are off alike in (nearly) all joints: their medians.

  Args:
    claimed: the joints' entries.
  """
  names = set.intersection(*(set(row["parameters"]) for row in claimed))
  parameters = {}
  for name in claimed[0]["parameters"]:
    if name not in names:
      continue
    values = np.array([row["parameters"][name]["value"] for row in claimed])
    widths = [row["parameters"][name]["high"] - row["parameters"][name]["low"] for row in claimed]
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(values - middle))) / np.sqrt(len(values))
    # Of a median: 1.25 times the deviation of a mean.
    reach = float(np.hypot(1.96 * 1.25 * scatter, 0.5 * np.median(widths)))
    parameters[name] = {"value": middle, "low": middle - reach, "high": middle + reach, "unit": "1"}
  gains = [row["evidence"]["gain_over_declared_nats"] for row in claimed]
  return {
    "kind": "parameter_error",
    "joint": None,
    "parameters": parameters,
    "evidence": {
      "gain_over_declared_nats": round(float(np.median(gains)), 4),
      "joints": [row["joint"] for row in claimed],
    },
  }


def _parameters(
  found: Effect, bounds: Any, term: Term, *, slide: bool
) -> dict[str, dict[str, Any]]:
  return {
    name: {
      "value": _plain(value),
      "low": _plain(bounds.get(name, (np.nan, np.nan))[0]),
      "high": _plain(bounds.get(name, (np.nan, np.nan))[1]),
      "unit": term.unit(name, slide=slide),
    }
    for name, value in found.parameters.items()
  }


def _runner_up(item: Found) -> float | None:
  size = len(decision.names(item.finding.chosen))
  behind = [
    e.score - item.finding.chosen.score
    for e in item.finding.alternatives
    if len(decision.names(e)) <= size
  ]
  return round(float(min(behind)), 4) if behind else None


def _plain(value: Any) -> Any:
  if isinstance(value, (list, tuple)):
    return list(value)
  return float(value) if np.isfinite(value) else None
