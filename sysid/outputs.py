"""Writes what an identification found, and reads it back to evaluate it on other logs.

report.json holds the findings, details.json what they rest on and all that `evaluate` needs: the
declared model's path, the extended model as effects, the joints' latencies.
"""

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
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.core.robot_logs.reading import COMMANDS, Log, LogError, check_motion
from nerf2real.suite.effects import Effect, write_effects
from nerf2real.suite.effects.files import from_list, to_list
from nerf2real.sysid.design import excitation
from nerf2real.sysid.model import extended_model
from nerf2real.sysid.model import simulation as evaluation
from nerf2real.sysid.model.simulation import Clocks
from nerf2real.sysid.report import page as report
from nerf2real.sysid.selection import decision, detection
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.selection.identification import (
  Settings,
  analyse,
  load_model,
  read_logs,
)
from nerf2real.sysid.sensors import sensing

_ANALYSIS, _SENSORS, _ERRORS = 0.8, 0.85, 0.95  # shares of the work done after each, about
_LISTED = 6  # alternatives in the report


def identify(
  model: Path,
  train: Sequence[Path],
  *,
  held: Sequence[Path] = (),
  reference: Sequence[Path] = (),
  out: Path,
  settings: Settings | None = None,
  progress: Progress = no_progress,
) -> dict[str, Any]:
  """Finds the effect that a model lacks and writes down what it found.

  Written are report.json, details.json, effects.json, model_extended.xml and report.html.

  Args:
    model: declared MuJoCo model.
    train: logs to identify from.
    held: logs on which only errors are reported.
    reference: logs of the same apparatus without the effect; they calibrate the constants first.
    out: folder to write.
    settings: thresholds and effort.
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
  settings = settings or Settings()
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
  analysing = part(progress, 0.0, _ANALYSIS)
  found = analyse(compiled, logs, reference=reference, settings=settings, progress=analysing)
  progress(_ANALYSIS, "sensors and floor")
  sensed = sensing.find(compiled, logs, reference, tilt=_tilt(found))
  found.objects += sensed.effects
  found.in_reference += sensed.in_reference
  if sensed.rows:
    found.effects += sensed.rows
    found.verdict = "effects" if found.verdict == "none" else found.verdict
  progress(_SENSORS, "errors on the logs")
  whole = [*found.calibration, *found.objects, *found.learned]
  content: dict[str, Any] = {
    "verdict": found.verdict,
    "effects": [] if found.verdict == "none" else found.effects,
    "in_reference": found.in_reference,
    "alternatives": _alternatives(found),
    "residual_at": residual_at(found),
    "error": {
      "train": _errors(found, logs, whole, settings),
      "held": _errors(found, held, whole, settings) if held else None,
      "floor": _floor(held or logs, [s.joint for s in found.screened]),
    },
    "window_s": None if _holds(found) else settings.window_s,
    "seconds": 0.0,
    "next_excitation": _next(found),
    "notes": sensed.notes,
  }
  # The best named hypothesis of a joint that stays unexplained is listed, not claimed.
  content["alternatives"] = [*found.nearest, *content["alternatives"]]
  if found.verdict == "unexplained":
    # What IMU, camera and floor show is explained all the same.
    claimed = [row for row in found.effects if row not in sensed.rows]
    content["alternatives"] = [*claimed, *content["alternatives"]]
    content["effects"] = list(sensed.rows)
  content["effects"] = content["effects"] + [
    {"kind": "residual_force", "joint": e.target, "parameters": {}, "evidence": {}}
    for e in found.learned
  ]
  if found.verdict == "effects" and found.unexplained:
    joints = ", ".join(item.joint for item in found.unexplained)
    content["notes"] = [
      *content["notes"],
      f"Not explained: {joints}. The effects that are named are those of other joints.",
    ]
  if found.verdict == "effects" and found.followed:
    joints = ", ".join(item.joint for item in found.followed)
    content["notes"] = [
      *content["notes"],
      f"Found by a simulation that follows the readings, as courses with play do not repeat:"
      f" {joints}. The errors before and after are of whole courses, which stray.",
    ]
  if found.in_reference:
    kinds = ", ".join(row["kind"] for row in found.in_reference)
    text = f"In the reference, too, so that nothing has changed: {kinds}. The model lacks it."
    content["notes"] = [*content["notes"], text]
  if found.verdict == "partly":
    joints = ", ".join(item.joint for item in found.unexplained)
    text = (
      f"More remains than the reference leaves, at {joints}: what is named is certain, not all."
    )
    content["notes"] = [*content["notes"], text]
  content["alternatives"] += sensed.alternatives
  write_effects(out / "effects.json", _claimed(found))
  extended_model.write(model, out / "model_extended.xml", [*found.calibration, *found.objects])
  details = _details(found, model, whole, sensed)
  write_atomically(out / "details.json", json.dumps(details, indent=2, allow_nan=False) + "\n")
  progress(_ERRORS, "report")
  content["seconds"] = round(time.perf_counter() - began, 1)
  made = report.page(found, content, details, held, whole, settings.window_s)
  page.write(out / "report.html", made)
  content["seconds"] = round(time.perf_counter() - began, 1)
  write_atomically(out / "report.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
  return content


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
  found: Identified, model: Path, extended: Sequence[Effect], sensed: sensing.Sensed
) -> dict[str, Any]:
  """Returns what the findings rest on, and what `evaluate` needs."""
  first = found.least_explained
  return {
    "model": str(model.resolve()),
    "extended": to_list(extended),
    "clocks": {j: {"skew": c.skew, "latency": c.latency} for j, c in found.clocks.items()},
    "calibration": {
      e.target: {n: round(float(v), 5) for n, v in e.parameters.items()}  # type: ignore[arg-type]
      for e in found.calibration
    },
    "tests": {
      "joint": first.screened.joint,
      "declared": detection.tests(first.screened.problem, first.ladder.declared.fit),
      "extended": detection.tests(first.screened.problem, first.finding.chosen.fit),
    },
    "audit": found.audits,
    "sensors": sensed.errors(),
  }


def evaluate(folder: Path, held: Sequence[Path]) -> list[dict[str, Any]]:
  """Returns the error of the declared and the extended model on further logs.

  Args:
    folder: what `identify` wrote.
    held: logs.
  """
  folder = Path(folder)
  for name in ("report.json", "details.json"):
    if not (folder / name).is_file():
      raise FileNotFoundError(
        f"Found no {folder / name}, expected a folder that identify.py wrote."
      )
  content = json.loads((folder / "report.json").read_text())
  details = json.loads((folder / "details.json").read_text())
  model = load_model(Path(details["model"]))
  effects = from_list(details["extended"])
  clocks = {joint: Clocks(**values) for joint, values in details["clocks"].items()}
  rows = []
  for log in read_logs(held, model):
    window = content["window_s"] or 0.5
    rows.append(
      {
        "log": log.name,
        "before": evaluation.error(model, [log], window_s=window),
        "after": evaluation.error(model, [log], effects, clocks=clocks, window_s=window),
      }
    )
  return rows


def _claimed(found: Identified) -> list[Effect]:
  """Returns the effects that go into effects.json.

  The constants of a joint go with its effects, which were fitted beside them.
  """
  if found.verdict == "none":
    return []
  joints = {f.screened.joint for f in found.found if f.finding.named}
  joints |= {e["joint"] for e in found.effects}
  all_off = any(e["kind"] == "parameter_error" and e["joint"] is None for e in found.effects)
  constants = [c for c in found.calibration if all_off or c.target in joints]
  return [*constants, *found.objects, *found.learned]


def _errors(
  found: Identified, logs: Sequence[Log], effects: Sequence[Effect], settings: Settings
) -> dict[str, float]:
  """Returns RMSE before and after, over the joints that the logs command."""
  window = settings.window_s
  return {
    "before": evaluation.error(found.model, logs, window_s=window),
    "after": evaluation.error(found.model, logs, effects, clocks=found.clocks, window_s=window),
  }


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
  return all(s.problem.plant.holds for s in found.screened)


def _alternatives(found: Identified) -> list[dict[str, Any]]:
  rows = []
  for item in found.found:
    for entry in item.finding.alternatives[:_LISTED]:
      rows.append(
        {
          "kinds": sorted(decision.names(entry)),
          "kind": "+".join(sorted(decision.names(entry))),
          "joint": item.screened.joint,
          "confounded": entry in item.finding.confounded,
          "parameters": {
            k: {n: round(v, 5) for n, v in entry.fit.values(k).items()}
            for k in sorted(decision.names(entry))
          },
          "evidence": decision.evidence(entry, item.ladder),
        }
      )
  return rows


def residual_at(found: Identified) -> dict[str, Any]:
  """Returns where the residual of the chosen hypothesis sits: joint, position, velocity, time."""
  item = found.least_explained
  problem, fit = item.screened.problem, item.finding.chosen.fit
  errors = problem.errors(problem.simulate(fit.terms, fit.x)[0])
  logs = problem.plant.logs
  joined = {
    "position": np.concatenate([log.position for log in logs]),
    "velocity": np.concatenate([log.velocity for log in logs]),
    "time": np.concatenate([log.time - log.time[0] for log in logs]),
  }
  squares = np.square(np.concatenate([along for along, _ in errors]))
  result: dict[str, Any] = {
    "joint": item.screened.joint,
    "rms": float(np.sqrt(np.mean(squares))) * problem.position_noise,
  }
  for name, values in joined.items():
    low, high, share = _concentrated(values, squares)
    result[name] = {"low": low, "high": high, "share_of_square": share}
  result["log"] = logs[int(np.argmax([np.mean(along**2) for along, _ in errors]))].name
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


def _next(found: Identified) -> dict[str, Any]:
  item = found.least_explained
  rivals = item.finding.confounded or item.finding.alternatives[:2]
  return excitation.propose(item.screened.problem, item.finding.chosen, rivals[:3])
