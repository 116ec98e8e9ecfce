"""What an identification says, as data: report.json, which the page shows."""

import collections
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.design import excitation
from nerf2real.sysid.design.identifiability import Identifiability
from nerf2real.sysid.model import simulation
from nerf2real.sysid.model.simulation import Member
from nerf2real.sysid.report import capability, servo
from nerf2real.sysid.selection.changed import Changed
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.judging.evidence import Scored, clear
from nerf2real.sysid.sensors import sensing
from nerf2real.sysid.settings import Settings

_LISTED = 6  # alternatives of a joint


def content_of(
  found: Identified,
  sensed: sensing.Sensed,
  shown: Sequence[Identifiability],
  *,
  held: Sequence[Log],
  settings: Settings,
) -> dict[str, Any]:
  """Returns what report.json holds, its seconds zero.

  Args:
    found: what motion shows, with what certain channels of their own add.
    sensed: what IMU, camera and floor show.
    shown: what the logs can show.
    held: logs that were not fitted.
    settings: windows of the errors.
  """
  logs, near = found.logs, found.near
  error = {
    "train": _errors(found, logs, near, settings),
    "held": _errors(found, held, near, settings) if held else None,
    "floor": _floor(held or logs, [j.joint for j in found.joints]),
  }
  effects = [] if found.verdict == "none" else found.effects
  # The best named hypothesis of a joint that stays unexplained is listed, not claimed.
  alternatives = [*found.nearest, *found.scopes, *_alternatives(found)]
  if found.verdict == "unexplained":
    # What IMU, camera and floor show is explained all the same.
    alternatives = [*(row for row in effects if row not in sensed.rows), *alternatives]
    effects = list(sensed.rows)
  return {
    "verdict": found.verdict,
    "effects": effects,
    "in_reference": found.in_reference,
    "alternatives": [*alternatives, *sensed.alternatives],
    "residual_at": residual_at(found),
    "error": error,
    "window_s": None if _holds(found) else settings.window_s,
    "seconds": 0.0,
    "next_excitation": _next(found, shown),
    "notes": [
      *(capability.sentence(shown), *servo.notes(found), *map(_of_one, found.scopes)),
      *sensed.notes,
      *_on_what_remains(found),
      *([_spread(error)] if len(near) > 1 else []),
    ],
  }


def _on_what_remains(found: Identified) -> list[str]:
  """Returns sentences on how joints were judged, on what is no news and on what is left."""
  notes = []
  if found.followed:
    joints = ", ".join(item.joint for item in found.followed)
    notes.append(
      f"Found by a simulation that follows the readings, as courses do not repeat (play, or where a"
      f" motion stops): {joints}. The errors before and after are of whole courses, which stray."
    )
  if found.in_reference:
    counts = collections.Counter(row["kind"] for row in found.in_reference)
    kinds = ", ".join(f"{k} ({n} times)" if n > 1 else k for k, n in counts.items())
    notes.append(
      f"In the reference, too, so that nothing has changed: {kinds}. The model lacks it."
    )
  if found.verdict == "partly":
    joints = ", ".join(item.joint for item in found.unexplained)
    notes.append(
      f"At {joints} more remains than the machine leaves anyway: the names are certain, not all."
    )
  return notes


def _errors(
  found: Identified, logs: Sequence[Log], near: Sequence[Member], settings: Settings
) -> dict[str, float]:
  """Returns RMSE before and after, over the joints that the logs command."""
  window = settings.window_s
  before = simulation.error(found.model, logs, window_s=window)
  return {"before": before} | simulation.errors(found.model, logs, near, window_s=window)


def _of_one(row: dict[str, Any]) -> str:
  """Returns a sentence on an effect of several joints that may be of one alone."""
  return (
    f"These logs do not tell whether {row['kind']} is of all joints or of {row['joint']} alone,"
    f" which is behind by {row['evidence']['behind_by_standard_errors']:.1f} standard errors."
  )


def _spread(error: dict[str, Any]) -> str:
  """Returns a sentence on the errors of fits near the best."""
  name = "held" if error["held"] else "train"
  found = error[name]
  return (
    f"Errors after are of the mean of {found['models']} fits near the best, which differ:"
    f" {found['median']:.3g} rad (or m) in the median, {found['least']:.3g} to {found['most']:.3g}"
    f" on the {name} logs; the model that is written alone has {found['single']:.3g}."
  )


def _floor(logs: Sequence[Log], joints: Sequence[str]) -> float:
  """Returns what no smooth model can explain, rad (or m) rms over joints.

  Readings scatter about any smooth motion by rounding, noise and stamps that are off while the
  joint moves: that is what their differences of fourth order keep (70 times its variance). The
  largest hundredth, stale readings, is left out.
  """
  squares = []
  for log in logs:
    position = log.states.position
    assert position is not None
    columns = [log.states.column(joint) for joint in joints]
    fourth = np.sort(np.square(np.diff(position[:, columns], n=4, axis=0)), axis=0)
    squares.append(fourth[: max(1, int(0.99 * len(fourth)))].mean(axis=0) / 70.0)
  return float(np.sqrt(np.mean(squares)))


def _holds(found: Identified) -> bool:
  return all(j.likelihood.plant.holds for j in found.joints)


def _alternatives(found: Identified) -> list[dict[str, Any]]:
  return [
    {
      "kinds": sorted(other.names),
      "kind": "+".join(sorted(other.names)),
      "joint": item.joint,
      "confounded": any(other is c for c in item.confounded),
      "parameters": {
        k: {n: round(v, 5) for n, v in other.values(k).items()} for k in sorted(other.names)
      },
      "evidence": _evidence(item, other),
    }
    for item in found.found
    for other in item.alternatives[:_LISTED]
  ]


def _evidence(item: Changed, other: Scored) -> dict[str, Any]:
  """Returns how a hypothesis of a joint stands beside the best one, as numbers."""
  return {
    "behind_by_standard_errors": round(clear(item.found.best, other), 2),
    "held_out_gain_nats": round(other.evidence - item.null.evidence, 2),
    "median_block_left": float(np.sqrt(np.median(other.fit.held[0][0]))),
  }


def residual_at(found: Identified) -> dict[str, Any]:
  """Returns where the residual of the extended model sits: joint, position, velocity, time."""
  item = found.least_explained
  logs = item.likelihood.plant.logs
  joined = {
    "position": np.concatenate([log.position for log in logs]),
    "velocity": np.concatenate([log.velocity for log in logs]),
    "time": np.concatenate([log.time - log.time[0] for log in logs]),
  }
  squares = np.square(item.extended.fit.residuals[0][0])
  result: dict[str, Any] = {"joint": item.joint, "rms": float(np.sqrt(np.mean(squares)))}
  for name, values in joined.items():
    low, high, share = _concentrated(values, squares)
    result[name] = {"low": low, "high": high, "share_of_square": share}
  ends = np.cumsum([len(log.time) for log in logs])[:-1]
  result["log"] = logs[int(np.argmax([np.mean(part) for part in np.split(squares, ends)]))].name
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


def _next(found: Identified, shown: Sequence[Identifiability]) -> dict[str, Any]:
  """Returns the motion that separates rivals best; without rivals, what shows most of the rest."""
  item = found.least_explained
  rivals = item.confounded or item.alternatives[:2]
  result = excitation.propose(item.likelihood, item.extended, rivals[:3])
  own = next(s for s in shown if s.joint == item.joint)
  if not rivals and own.motion is not None:
    result["design"] = own.motion
  result["would"] = capability.deeds(own.resolved.get(result["design"], ()))
  return result
