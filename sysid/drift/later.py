"""Compares later logs with a result that was stored: errors, and whether it still holds."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nerf2real.core.files import write_atomically
from nerf2real.core.pages import page
from nerf2real.core.robot_logs.reading import Log, check_motion
from nerf2real.core.serialization import to_plain
from nerf2real.sysid.data.opening import read_logs, set_aside
from nerf2real.sysid.drift import page as drift_page
from nerf2real.sysid.drift.judgement import Drift, judge
from nerf2real.sysid.drift.stored import Stored, read
from nerf2real.sysid.model import simulation
from nerf2real.sysid.settings import SETTINGS, Settings


def evaluate(folder: Path, held: Sequence[Path]) -> list[dict[str, Any]]:
  """Returns the error of the declared and the extended model on further logs.

  Args:
    folder: what `identify` wrote.
    held: logs.

  Raises:
    FileNotFoundError: a file is missing.
    LogError: a log cannot be used.
    ValueError: the folder is not of this version.
  """
  stored = read(folder)
  window = stored.content["window_s"] or SETTINGS.window_s
  rows = []
  for log in _logs(held, stored):
    errors = simulation.errors(stored.model, [log], stored.near, window_s=window)
    rows.append({"log": log.name, **errors})
  return rows


def check_drift(
  folder: Path, held: Sequence[Path], *, out: Path | None = None, settings: Settings = SETTINGS
) -> Drift:
  """Judges whether a stored result still holds of later logs; writes drift.json and drift.html.

  Args:
    folder: what `identify` wrote.
    held: later logs.
    out: folder to write; the same for None.
    settings: level of significance, what two recordings of a machine differ by.

  Raises:
    FileNotFoundError: a file is missing.
    LogError: a log cannot be used, or lacks a joint of the result.
    OSError: the folder cannot be written.
    ValueError: the folder is not of this version.
  """
  stored = read(folder)
  logs = _logs(held, stored)
  check_motion(logs)
  found = judge(stored, logs, settings=settings)
  out = Path(out or folder)
  out.mkdir(parents=True, exist_ok=True)
  content = {
    "holds": found.holds,
    "sentence": drift_page.sentence(found),
    **to_plain(found),
    "level": settings.level,
  }
  write_atomically(out / "drift.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
  page.write(out / "drift.html", drift_page.page(found, stored, logs))
  return found


def _logs(paths: Sequence[Path], stored: Stored) -> list[Log]:
  """Returns later logs, of which those joints are judged that were."""
  return [set_aside(log, stored.not_judged) for log in read_logs(paths, stored.model)]
