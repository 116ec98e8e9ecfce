"""Writes what an identification found.

report.json holds the findings, details.json what they rest on and all that `drift` needs of later
logs: the declared model's path, the extended model as effects, the joints' hypotheses.
"""

import collections
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.files import write_atomically
from nerf2real.core.folder_lock import lock_folder
from nerf2real.core.pages import page
from nerf2real.core.progress import Progress, no_progress
from nerf2real.core.robot_logs.reading import COMMANDS, Log, LogError, check_motion
from nerf2real.core.serialization import to_plain
from nerf2real.suite.effects import Effect, write_effects
from nerf2real.sysid.data.opening import load_model, read_logs
from nerf2real.sysid.design import excitation, identifiability
from nerf2real.sysid.design.identifiability import Identifiability
from nerf2real.sysid.drift import stored
from nerf2real.sysid.fit import whitening
from nerf2real.sysid.model import extended_model
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.simulation import Member
from nerf2real.sysid.report import capability, samples, servo
from nerf2real.sysid.report import page as report
from nerf2real.sysid.selection.analysis import analyse
from nerf2real.sysid.selection.changes import Changed
from nerf2real.sysid.selection.evidence import Scored, clear
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.sensors import sensing
from nerf2real.sysid.settings import SETTINGS, Settings

_SHOWN, _ANALYSIS, _SENSORS, _ERRORS = (
  0.05,
  0.8,
  0.85,
  0.95,
)  # shares of the work done after each, about
_LISTED = 6  # alternatives in the report


def identify(
  model: Path,
  train: Sequence[Path],
  *,
  held: Sequence[Path] = (),
  reference: Sequence[Path] = (),
  out: Path,
  settings: Settings = SETTINGS,
  progress: Progress = no_progress,
) -> dict[str, Any]:
  """Finds the effect that a model lacks and writes down what it found.

  Written are report.json, details.json, effects.json, model_extended.xml and report.html.

  Args:
    model: declared MuJoCo model.
    train: logs to identify from.
    held: logs on which only errors are reported.
    reference: logs of the same apparatus without the effect: what differs is looked for.
    out: folder to write.
    settings: tolerances and effort.
    progress: called with the fraction done and a text.

  Returns:
    The content of report.json.

  Raises:
    FileNotFoundError: a file is missing.
    FolderInUseError: another process identifies into the folder.
    OSError: the folder cannot be written.
    LogError: a log cannot be used, or the held or reference logs lack a joint of the others.
    ValueError: the model cannot be read, or there is no log.
  """
  if not train:
    raise ValueError("Found no log to identify from, expected at least one --logs file.")
  compiled = load_model(Path(model))
  logs, others = read_logs(train, compiled), read_logs(held, compiled)
  healthy = read_logs(reference, compiled)
  check_motion(logs)
  _check_joints(logs, [*others, *healthy])
  with lock_folder(out):
    return _identify(
      Path(model),
      compiled,
      logs,
      held=others,
      reference=healthy,
      out=Path(out),
      settings=settings,
      progress=progress,
    )


def _identify(
  model: Path,
  compiled: mujoco.MjModel,
  logs: list[Log],
  *,
  held: list[Log],
  reference: list[Log],
  out: Path,
  settings: Settings,
  progress: Progress,
) -> dict[str, Any]:
  """Analyses logs that were read, and writes; see `identify`."""
  began = time.perf_counter()
  progress(0.0, "what the logs can show")
  shown = identifiability.of_machine(compiled, logs, repeated=bool(reference), settings=settings)
  progress(_SHOWN, "comparing with the reference" if reference else "explaining every joint")
  found = analyse(compiled, logs, reference, settings=settings)
  by_duty, before = servo.rows(found)
  found.in_reference += before
  _add(found, by_duty)
  progress(_ANALYSIS, "sensors and floor")
  sensed = sensing.find(compiled, logs, reference, tilt=_tilt(found))
  found.objects += sensed.effects
  found.in_reference += sensed.in_reference
  _add(found, sensed.rows, moves=False)
  progress(_SENSORS, "errors on the logs")
  whole = [*found.calibration, *found.objects]
  near = found.near
  content: dict[str, Any] = {
    "verdict": found.verdict,
    "effects": [] if found.verdict == "none" else found.effects,
    "in_reference": found.in_reference,
    "alternatives": _alternatives(found),
    "residual_at": residual_at(found),
    "error": {
      "train": _errors(found, logs, near, settings),
      "held": _errors(found, held, near, settings) if held else None,
      "floor": _floor(held or logs, [j.joint for j in found.joints]),
    },
    "window_s": None if _holds(found) else settings.window_s,
    "seconds": 0.0,
    "next_excitation": _next(found, shown),
    "notes": [capability.sentence(shown), *servo.notes(found), *sensed.notes],
  }
  # The best named hypothesis of a joint that stays unexplained is listed, not claimed.
  content["alternatives"] = [*found.nearest, *content["alternatives"]]
  if found.verdict == "unexplained":
    # What IMU, camera and floor show is explained all the same.
    claimed = [row for row in found.effects if row not in sensed.rows]
    content["alternatives"] = [*claimed, *content["alternatives"]]
    content["effects"] = list(sensed.rows)
  if found.followed:
    joints = ", ".join(item.joint for item in found.followed)
    content["notes"] = [
      *content["notes"],
      f"Found by a simulation that follows the readings, as courses with play do not repeat:"
      f" {joints}. The errors before and after are of whole courses, which stray.",
    ]
  if found.in_reference:
    counts = collections.Counter(row["kind"] for row in found.in_reference)
    kinds = ", ".join(f"{k} ({n} times)" if n > 1 else k for k, n in counts.items())
    text = f"In the reference, too, so that nothing has changed: {kinds}. The model lacks it."
    content["notes"] = [*content["notes"], text]
  if found.verdict == "partly":
    joints = ", ".join(item.joint for item in found.unexplained)
    text = (
      f"At {joints} more remains than the machine leaves anyway: the names are certain, not all."
    )
    content["notes"] = [*content["notes"], text]
  if len(near) > 1:
    content["notes"] = [*content["notes"], _spread(content["error"])]
  content["alternatives"] += sensed.alternatives
  drawn = samples.with_samples(found, _claimed(found), np.random.default_rng(0))
  write_effects(out / "effects.json", servo.apart(drawn, by_duty))
  extended_model.write(model, out / "model_extended.xml", [*found.calibration, *found.objects])
  details = _details(found, model, near, sensed)
  details["identifiability"] = [to_plain(item) for item in shown]
  details["joints"] = stored.to_json(stored.remembered(found, held, settings))
  write_atomically(out / "details.json", json.dumps(details, indent=2, allow_nan=False) + "\n")
  progress(_ERRORS, "report")
  content["seconds"] = round(time.perf_counter() - began, 1)
  made = report.page(
    found, content, details, held=held, effects=whole, shown=shown, window_s=settings.window_s
  )
  page.write(out / "report.html", made)
  content["seconds"] = round(time.perf_counter() - began, 1)
  write_atomically(out / "report.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
  return content


def _add(found: Identified, rows: list[dict[str, Any]], *, moves: bool = True) -> None:
  """Adds entries that are certain by channels of their own.

  Args:
    found: what joints' motion shows; changed.
    rows: entries.
    moves: whether they explain a part of the motion.
  """
  if rows:
    found.effects += rows
    grade = {"none": "effects"} | ({"unexplained": "partly"} if moves else {})
    found.verdict = grade.get(found.verdict, found.verdict)


def _tilt(found: Identified) -> dict[str, float] | None:
  """Returns how far gravity is turned, where that is claimed."""
  claimed = any(row["kind"] == "gravity_tilt" for row in found.effects)
  tilts = [e for e in found.objects if e.kind == "gravity_tilt"] if claimed else []
  return {n: float(v) for n, v in tilts[0].parameters.items()} if tilts else None  # type: ignore[arg-type]


def _check_joints(logs: Sequence[Log], others: Sequence[Log]) -> None:
  """Raises a LogError where a held or reference log lacks a joint of the logs that are fitted."""
  wanted = [j for j in logs[0].commands.joints if all(j in log.commands.joints for log in logs)]
  for log in others:
    missing = [j for j in wanted if j not in log.commands.joints]
    if missing:
      raise LogError(
        f"{log.name} has no commands for {missing}: found {list(log.commands.joints)} in "
        f"{COMMANDS}, expected the joints of the logs to identify from; record the same joints."
      )


def _details(
  found: Identified, model: Path, near: Sequence[Member], sensed: sensing.Sensed
) -> dict[str, Any]:
  """Returns what the findings rest on, and what the extended model is simulated with."""
  first = found.least_explained
  return {
    "model": str(model.resolve()),
    **stored.member_to_json(near[0]),
    "near": [stored.member_to_json(member) for member in near[1:]],
    "calibration": {
      e.target: {n: round(float(v), 5) for n, v in e.parameters.items()}  # type: ignore[arg-type]
      for e in found.calibration
    },
    "tests": {
      "joint": first.joint,
      **{
        name: whitening.tests(first.likelihood, item.fit.residuals[0][0])
        for name, item in (("declared", first.declared), ("extended", first.extended))
      },
    },
    "audit": found.audits,
    "servo": {j.joint: to_plain(j.likelihood.law) for j in found.joints if j.likelihood.law},
    "sensors": sensed.errors(),
  }


def _claimed(found: Identified) -> list[Effect]:
  """Returns the effects that go into effects.json.

  The constants of a joint go with its effects, which were fitted beside them.
  """
  if found.verdict == "none":
    return []
  joints = {e["joint"] for e in (*found.effects, *found.nearest)}
  all_off = any(e["kind"] == "parameter_error" and e["joint"] is None for e in found.effects)
  constants = [c for c in found.calibration if all_off or c.target in joints]
  return [*constants, *found.objects]


def _errors(
  found: Identified, logs: Sequence[Log], near: Sequence[Member], settings: Settings
) -> dict[str, float]:
  """Returns RMSE before and after, over the joints that the logs command."""
  window = settings.window_s
  before = evaluation.error(found.model, logs, window_s=window)
  return {"before": before} | evaluation.errors(found.model, logs, near, window_s=window)


def _spread(error: dict[str, Any]) -> str:
  """Returns a sentence on the errors of fits near the best."""
  name = "held" if error["held"] else "train"
  found = error[name]
  return (
    f"Errors after are of the weighted mean of {found['models']} fits near the best, which differ:"
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
