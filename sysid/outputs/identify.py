"""Writes what an identification found.

report.json holds the findings, details.json what they rest on and all that `drift` needs of later
logs: the declared model's path, the extended model as effects, the joints' hypotheses.
"""

import collections
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from nerf2real.core.files import write_atomically
from nerf2real.core.folder_lock import lock_folder
from nerf2real.core.pages import page
from nerf2real.core.progress import Progress, no_progress, part
from nerf2real.core.robot_logs.reading import COMMANDS, Log, LogError, check_motion
from nerf2real.core.serialization import to_plain
from nerf2real.suite.effects import write_effects
from nerf2real.sysid.data.checks import check_distinct, check_length
from nerf2real.sysid.data.opening import load_model, read_logs, set_aside
from nerf2real.sysid.data.plausibility import doubts
from nerf2real.sysid.design import identifiability
from nerf2real.sysid.drift import stored
from nerf2real.sysid.fit import resolution
from nerf2real.sysid.model.limits.supported import left_out, on_a_stand
from nerf2real.sysid.model.machine import Machine
from nerf2real.sysid.model.numerics import Numerics
from nerf2real.sysid.model.simulation import errors
from nerf2real.sysid.outputs import extended_model
from nerf2real.sysid.outputs.details import claimed_effects, details_of
from nerf2real.sysid.outputs.notes import (
  another_session,
  far,
  finer,
  growing,
  long_step,
  not_judged,
  of_one,
  on_stand,
  open_loads,
  spread,
  still,
  supply,
  unmeasured,
)
from nerf2real.sysid.outputs.rivals import alternatives, next_motion, residual_at
from nerf2real.sysid.report import capability, samples, servo
from nerf2real.sysid.report import page as report
from nerf2real.sysid.selection.analysis import analyse
from nerf2real.sysid.selection.findings import Identified
from nerf2real.sysid.sensors import sensing
from nerf2real.sysid.settings import SETTINGS, Settings

# Shares of the work done after each, about.
_REDUCED, _SHOWN, _ANALYSIS, _SENSORS, _ERRORS = 0.05, 0.25, 0.9, 0.92, 0.97


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
    LogError: a log cannot be used or is given twice, or the held or reference logs lack a joint of
      the others.
    ValueError: the model cannot be read, or has what is not simulated, or there is no log.
  """
  if not train:
    raise ValueError("Found no log to identify from, expected at least one --logs file.")
  check_distinct([*train, *held, *reference])
  compiled = load_model(Path(model))
  logs, others = read_logs(train, compiled), read_logs(held, compiled)
  healthy = read_logs(reference, compiled)
  for recorded in filter(None, (logs, healthy)):
    check_motion(recorded)
    check_length(recorded, settings.block_s)
  _check_joints(logs, [*others, *healthy])
  stand = on_a_stand(Path(model), compiled)
  beyond = left_out(stand, [*logs, *healthy])
  logs, others, healthy = (
    [set_aside(log, beyond) for log in part] for part in (logs, others, healthy)
  )
  with lock_folder(out):
    return _identify(
      Path(model),
      compiled,
      stand,
      logs,
      beyond=beyond,
      held=others,
      reference=healthy,
      out=Path(out),
      settings=settings,
      progress=progress,
    )


def _identify(
  model: Path,
  compiled: mujoco.MjModel,
  stand: mujoco.MjModel,
  logs: list[Log],
  *,
  beyond: Mapping[str, str],
  held: list[Log],
  reference: list[Log],
  out: Path,
  settings: Settings,
  progress: Progress,
) -> dict[str, Any]:
  """Analyses logs that were read, and writes; see `identify`."""
  began = time.perf_counter()
  progress(0.0, "one joint of many: what each feels of the others")
  machine = Machine(stand, logs, window_s=settings.window_s)
  declared, used = Numerics(machine.reductions[0].step), resolution.numerics(machine)
  if used != declared:
    used.apply(stand)
    used.apply(compiled)
    machine = Machine(stand, logs, window_s=settings.window_s)
  shown = identifiability.of_machine(
    machine,
    repeated=bool(reference),
    settings=settings,
    progress=part(progress, _REDUCED, _SHOWN),
  )
  found = analyse(
    stand,
    logs,
    reference,
    machine=machine,
    settings=settings,
    progress=part(progress, _SHOWN, _ANALYSIS),
  )
  by_duty, before = servo.rows(found)
  found.in_reference += before
  _add(found, by_duty)
  progress(_ANALYSIS, "sensors and floor")
  sensed = sensing.find(compiled, logs, reference, tilt=_tilt(found))
  said = sensed.whole
  found.objects += said.effects
  found.in_reference += said.in_reference
  _add(found, said.rows, moves=False)
  progress(_SENSORS, "errors on the logs")
  whole = [*found.calibration, *found.objects]
  near = found.near
  content: dict[str, Any] = {
    "verdict": found.verdict,
    "effects": [] if found.verdict == "none" else _effects_first(found.effects),
    "in_reference": found.in_reference,
    # The best named hypothesis of a joint that stays unexplained is listed, not claimed.
    "alternatives": [
      *(*_effects_first(found.nearest), *found.scopes, *found.twins),
      *(*alternatives(found), *said.alternatives),
    ],
    "residual_at": residual_at(found),
    "error": {
      "train": errors(stand, logs, near, window_s=settings.window_s),
      "held": errors(stand, held, near, window_s=settings.window_s) if held else None,
      "floor": _floor(held or logs, [j.joint for j in found.joints]),
    },
    "window_s": None if _holds(found) else settings.window_s,
    "seconds": 0.0,
    "next_excitation": next_motion(found, shown),
    "notes": [
      *(capability.sentence(shown), *servo.notes(found), *map(of_one, found.scopes)),
      *still(found.still),
      *growing(found.found),
      *open_loads(found.effects if found.verdict != "none" else ()),
      *doubts([*logs, *held, *reference], compiled),
      *not_judged(beyond),
      *on_stand(free=stand is not compiled),
      *unmeasured(compiled, logs),
      *finer(declared, used),
      *long_step(found.joints),
      *supply(logs, reference),
      *(note for item in found.found for note in another_session(item)),
      *dict.fromkeys(said.notes),
    ],
  }
  if found.followed:
    joints = ", ".join(item.joint for item in found.followed)
    content["notes"].append(
      "Found by a simulation that follows the readings, as courses do not repeat (play, where a "
      f"motion stops, or where no actuator holds a position): {joints}. The errors before and "
      f"after are of {'whole courses' if _holds(found) else 'windows'}, which stray."
    )
  if found.in_reference:
    counts = collections.Counter(row["kind"] for row in found.in_reference)
    kinds = ", ".join(f"{k} ({n} times)" if n > 1 else k for k, n in counts.items())
    lacks = "it" if counts.total() == 1 else "them"
    text = f"In the reference, too, so that nothing has changed: {kinds}. The model lacks {lacks}."
    content["notes"].append(text)
  if found.verdict == "partly":
    joints = ", ".join(item.joint for item in found.unexplained)
    text = (
      f"At {joints} more remains than the machine leaves anyway: the names are certain, not all."
    )
    content["notes"].append(text)
  if found.verdict == "none" and not reference:
    content["notes"] += far(content["error"])
  if len(near) > 1:
    content["notes"].append(spread(content["error"]))
  drawn = samples.with_samples(found, claimed_effects(found), np.random.default_rng(0))
  write_effects(out / "effects.json", servo.apart(drawn, by_duty))
  finer_ones = None if used == declared else used
  extended_model.write(
    model,
    out / "model_extended.xml",
    whole,
    clocks=found.clocks,
    numerics=finer_ones,
    on_stand=stand is not compiled,
  )
  details = details_of(found, model, near, sensed)
  details["numerics"] = to_plain(finer_ones)
  details["not_judged"] = dict(beyond)
  details["identifiability"] = [to_plain(item) for item in shown]
  details["joints"] = stored.to_json(stored.remembered(found, held, settings))
  write_atomically(out / "details.json", json.dumps(details, indent=2, allow_nan=False) + "\n")
  progress(_ERRORS, "report")
  content["seconds"] = round(time.perf_counter() - began, 1)
  made = report.page(
    found,
    content,
    details,
    held=held,
    effects=whole,
    shown=shown,
    window_s=settings.window_s,
    referred=bool(reference),
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


def _effects_first(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
  """Returns entries with those of constants last: they go with what is missing."""
  return sorted(rows, key=lambda row: row["kind"] == "parameter_error")


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
