"""Where the residual sits, hypotheses beside the best one, the motion that separates them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.sysid.design import excitation
from nerf2real.sysid.design.identifiability import Identifiability
from nerf2real.sysid.fit.likelihood import rms_of
from nerf2real.sysid.report import capability
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.joints.changes import Changed
from nerf2real.sysid.selection.search.evidence import Scored, clear

_LISTED = 6  # alternatives in the report


def residual_at(found: Identified) -> dict[str, Any]:
  """Returns where the residual of the extended model sits: joint, position, velocity, time; where
  a force of any form is in it, that of the best model without, which shows what the force does."""
  item = found.least_explained
  best = item.extended
  if best.beside_force:
    best = next(s for s in item.ranked if not s.beside_force and not s.neutral)
  logs = item.likelihood.plant.logs
  joined = {
    "position": np.concatenate([log.position for log in logs]),
    "velocity": np.concatenate([log.velocity for log in logs]),
    "time": np.concatenate([log.time - log.time[0] for log in logs]),
  }
  courses = item.likelihood.courses(best.terms, best.fit.x)
  squares = np.square(np.concatenate(courses))
  read = np.isfinite(squares)
  result: dict[str, Any] = {"joint": item.joint, "rms": rms_of(courses)}
  for name, values in joined.items():
    low, high, share = _concentrated(values[read], squares[read])
    result[name] = {"low": low, "high": high, "share_of_square": share}
  result["log"] = logs[int(np.argmax([rms_of([course]) for course in courses]))].name
  return result


def _concentrated(values: np.ndarray, squares: np.ndarray) -> tuple[float, float, float]:
  """Returns the fifth of a quantity's samples that holds most of the squared residual."""
  edges = np.quantile(values, np.linspace(0, 1, 11))
  which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, 9)
  sums = np.bincount(which, squares, 10)
  pairs = sums[:-1] + sums[1:]
  best = int(np.argmax(pairs))
  share = float(pairs[best] / max(sums.sum(), 1e-12))
  return float(edges[best]), float(edges[best + 2]), round(share, 3)


def alternatives(found: Identified) -> list[dict[str, Any]]:
  return [
    {
      "kinds": sorted(other.names),
      "kind": "+".join(sorted(other.names)),
      "joint": item.joint,
      "confounded": other.names in {c.names for c in item.confounded},
      "parameters": {
        k: {n: round(v, 5) for n, v in other.values(k).items()} for k in sorted(other.names)
      },
      "evidence": _evidence(item, other),
    }
    for item in found.found
    for other in _listed(item)
  ]


def _listed(item: Changed) -> list[Scored]:
  """Returns the likeliest hypotheses, first those that predict what the named one does."""
  twins = {c.names for c in item.confounded}
  return sorted(item.alternatives, key=lambda other: other.names not in twins)[:_LISTED]


def _evidence(item: Changed, other: Scored) -> dict[str, Any]:
  """Returns how a hypothesis of a joint stands beside the best one, as numbers."""
  return {
    "behind_by_standard_errors": round(clear(item.found.best, other), 2),
    "held_out_gain_nats": round(other.evidence - item.null.evidence, 2),
    "median_block_left": float(np.sqrt(np.median(other.fit.held[0][0]))),
  }


def next_motion(found: Identified, shown: Sequence[Identifiability]) -> dict[str, Any]:
  """Returns the motion that separates rivals best; without rivals, what shows most of the rest."""
  item = found.least_explained
  rivals = item.confounded or item.alternatives[:2]
  result = excitation.propose(item.likelihood, item.extended, rivals[:3])
  own = next(s for s in shown if s.joint == item.joint)
  if not rivals and own.motion is not None:
    result["design"] = own.motion
  result["would"] = capability.deeds(own.resolved.get(result["design"], ()))
  return result
