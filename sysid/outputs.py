"""Writes what an identification found, and reads it back to evaluate it on other logs."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from suite.effects import Effect, read_effects, write_effects
from sysid import decision, detection, evaluation, excitation, extended_model, report
from sysid.evaluation import Clocks
from sysid.identification import Found, Identified, Settings, analyse, load_model, read_logs
from sysid.logs import Log

_LISTED = 6  # alternatives in the report


def identify(
  model: Path,
  train: Sequence[Path],
  *,
  held: Sequence[Path] = (),
  reference: Sequence[Path] = (),
  out: Path,
  settings: Settings | None = None,
) -> dict[str, Any]:
  """Finds the effect that a model lacks and writes down what it found.

  Written are report.json, effects.json, calibration.json, model_extended.xml and report.html.

  Args:
    model: declared MuJoCo model.
    train: logs to identify from.
    held: logs on which only errors are reported.
    reference: logs of the same apparatus without the effect; they calibrate the constants first.
    out: folder to write.
    settings: thresholds and effort.

  Returns:
    The content of report.json.

  Raises:
    FileNotFoundError: a file is missing.
    LogError: a log cannot be used.
    ValueError: the model cannot be read, or there is no log.
  """
  began = time.perf_counter()
  settings = settings or Settings()
  if not train:
    raise ValueError("Found no log to identify from, expected at least one --logs file.")
  compiled = load_model(Path(model))
  logs, others = read_logs(train, compiled), read_logs(held, compiled)
  found = analyse(compiled, logs, reference=read_logs(reference, compiled), settings=settings)
  out = Path(out)
  out.mkdir(parents=True, exist_ok=True)
  whole = [*found.calibration, *found.objects, *found.learned]
  content: dict[str, Any] = {
    "verdict": found.verdict,
    "effects": [] if found.verdict == "none" else found.effects,
    "alternatives": _alternatives(found),
    "residual_at": residual_at(found),
    "error": {
      "train": _errors(found, logs, whole, settings),
      "held": _errors(found, others, whole, settings) if others else None,
      "floor": _floor(found),
    },
    "window_s": None if _holds(found) else settings.window_s,
    "seconds": 0.0,
    "next_excitation": _next(found),
  }
  if found.verdict == "unexplained":
    # The best named hypothesis is no explanation: it is listed, not claimed.
    content["alternatives"] = [*content["effects"], *content["alternatives"]]
    content["effects"] = [
      {"kind": "residual_force", "joint": e.target, "parameters": {}, "evidence": {}}
      for e in found.learned
    ]
  first = found.found[0]
  content["tests"] = {
    "declared": detection.tests(first.screened.problem, first.ladder.declared.fit),
    "extended": detection.tests(first.screened.problem, first.finding.chosen.fit),
  }
  content["audit"] = found.audits
  content["model"] = str(Path(model).resolve())
  content["calibration"] = {
    e.target: {n: round(float(v), 5) for n, v in e.parameters.items()}  # type: ignore[arg-type]
    for e in found.calibration
  }
  write_effects(out / "effects.json", _claimed(found))
  write_effects(out / "calibration.json", [*found.calibration])
  (out / "clocks.json").write_text(
    json.dumps({j: [c.skew, c.latency] for j, c in found.clocks.items()}, indent=2) + "\n"
  )
  extended_model.write(
    Path(model), out / "model_extended.xml", [*found.calibration, *found.objects]
  )
  content["seconds"] = round(time.perf_counter() - began, 1)
  (out / "report.html").write_text(report.page(found, content, others, whole, settings.window_s))
  content["seconds"] = round(time.perf_counter() - began, 1)
  (out / "report.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
  return content


def evaluate(folder: Path, held: Sequence[Path]) -> list[dict[str, Any]]:
  """Returns the error of the declared and the extended model on further logs.

  Args:
    folder: what `identify` wrote.
    held: logs.
  """
  folder = Path(folder)
  if not (folder / "report.json").is_file():
    raise FileNotFoundError(
      f"Found no {folder / 'report.json'}, expected a folder that identify.py wrote."
    )
  content = json.loads((folder / "report.json").read_text())
  model = load_model(Path(content["model"]))
  effects = [
    *read_effects(folder / "calibration.json"), *read_effects(folder / "effects.json")
  ]  # fmt: skip
  raw = json.loads((folder / "clocks.json").read_text())
  clocks = {joint: Clocks(*values) for joint, values in raw.items()}
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
  """Returns the effects that go into effects.json."""
  if found.verdict == "none":
    return []
  if found.verdict == "unexplained":
    return [*found.objects, *found.learned]
  return list(found.objects)


def _errors(
  found: Identified, logs: Sequence[Log], effects: Sequence[Effect], settings: Settings
) -> dict[str, float]:
  """Returns RMSE before and after, over the joints that the logs command."""
  window = settings.window_s
  return {
    "before": evaluation.error(found.model, logs, window_s=window),
    "after": evaluation.error(found.model, logs, effects, clocks=found.clocks, window_s=window),
  }


def _floor(found: Identified) -> float:
  """Returns the noise of the position readings, rad: what no model can explain."""
  noise = [s.problem.position_noise for s in found.screened]
  return float(np.sqrt(np.mean(np.square(noise))))


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
  item = found.found[0]
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
  item: Found = found.found[0]
  rivals = item.finding.confounded or item.finding.alternatives[:2]
  return excitation.propose(item.screened.problem, item.finding.chosen, rivals[:3])
