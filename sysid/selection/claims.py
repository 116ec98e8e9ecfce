"""What is claimed: findings as entries of a report, and as effects that can be simulated."""

from typing import Any

import numpy as np

from nerf2real.suite.effects import Effect
from nerf2real.sysid.fit import intervals
from nerf2real.sysid.fit.layout import CONSTANTS
from nerf2real.sysid.hypotheses import free_force
from nerf2real.sysid.hypotheses.terms import Term
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.joints.subject import WHOLE
from nerf2real.sysid.settings import SETTINGS

Claim = tuple[Effect, dict[str, Any]]
"""An effect and its entry in the report."""

Array = np.ndarray


def effect(item: Changed, term: Term, evidence: dict[str, Any]) -> Claim:
  """Returns an effect of a joint's extended hypothesis, with intervals.

  Args:
    item: the joint.
    term: the effect.
    evidence: for the report.
  """
  fit = item.extended.fit
  slide = not item.likelihood.plant.hinge
  alone = item.subject.before is None
  bounds = intervals.intervals(item.likelihood, fit, term, own_latency=alone)
  found = term.effect(np.array(list(fit.values(term).values())), bounds)
  if term.kind == CONSTANTS:  # factors are told
    bounds = dict(found.intervals)
  row = {
    "kind": found.kind,
    "joint": None if term.kind in WHOLE else item.joint,
    **({"body": term.target} if term.kind == "payload" else {}),
    "parameters": _parameters(found, bounds, term, slide=slide),
    "evidence": evidence,
  }
  return found, row


def free(item: Changed, term: Term) -> Claim:
  """Returns the force of any form of a joint's extended hypothesis: a table, and no name."""
  values = item.extended.fit.values(term)
  found = free_force.effect(term, np.array(list(values.values())))
  return found, {"kind": found.kind, "joint": item.joint, "parameters": {}, "evidence": {}}


def shared(
  term: Term,
  x: Array,
  bounds: dict[str, tuple[float, float]],
  evidence: dict[str, Any],
  *,
  slide: bool,
) -> Claim:
  """Returns an effect of several joints.

  Args:
    term: the effect.
    x: its values [n].
    bounds: their intervals.
    evidence: for the report.
    slide: whether all of the joints are slides.
  """
  found = term.effect(x, bounds)
  parameters = _parameters(found, bounds, term, slide=slide)
  return found, {
    "kind": found.kind,
    "joint": None,
    "parameters": parameters,
    "evidence": evidence,
  }


def zero(
  joint: str,
  offset: float,
  interval: tuple[float, float],
  evidence: dict[str, Any],
  *,
  slide: bool,
) -> dict[str, Any]:
  """Returns the entry of a joint's shifted zero that the others' motion shows, too.

  Args:
    joint: which joint.
    offset: of its readings, rad or m.
    interval: of that.
    evidence: for the report.
    slide: whether the joint is a slide.
  """
  low, high = interval
  unit = "m" if slide else "rad"
  parameters = {"offset": {"value": offset, "low": low, "high": high, "unit": unit}}
  return {
    "kind": "encoder_offset",
    "joint": joint,
    "parameters": parameters,
    "evidence": evidence,
  }


def alone(term: Term, joint: str, behind: float, x: Array) -> dict[str, Any]:
  """Returns the entry of an alternative: an effect of several joints that may be of one alone.

  Args:
    term: the effect.
    joint: which joint.
    behind: standard errors by which that is less likely.
    x: its values there [n].
  """
  evidence = {"behind_by_standard_errors": round(behind, 2)}
  return _alternative(term, x) | {"joint": joint, "evidence": evidence}


def alike(term: Term, x: Array) -> dict[str, Any]:
  """Returns the entry of an alternative: an effect of several joints that predicts the same as a
  claimed one.

  Args:
    term: the effect.
    x: its values [n].
  """
  return _alternative(term, x) | {"confounded": True}


def _alternative(term: Term, x: Array) -> dict[str, Any]:
  values = {n: round(float(v), 5) for n, v in zip(term.names, x, strict=True)}
  return {
    "kinds": [term.kind],
    "kind": term.kind,
    "joint": None,
    "confounded": False,
    "parameters": {term.kind: values},
    "evidence": {},
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
    reach = float(np.hypot(SETTINGS.sigmas * 1.25 * scatter, 0.5 * np.median(widths)))
    parameters[name] = {"value": middle, "low": middle - reach, "high": middle + reach, "unit": "1"}
  return {
    "kind": "parameter_error",
    "joint": None,
    "parameters": parameters,
    "evidence": {
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


def _plain(value: Any) -> Any:
  return float(value) if np.isfinite(value) else None
