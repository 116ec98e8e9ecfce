"""Closes the loop once: excite a robot, record, identify, simulate with the effects, compare."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf2real import sysid
from nerf2real.core.files import atomic_path, write_atomically
from nerf2real.core.folder_lock import lock_folder
from nerf2real.evaluation.loop import gap, recording
from nerf2real.evaluation.loop.motions import HELD, TRAIN, declared_model


class Closed(NamedTuple):
  """What a loop gave."""

  content: dict[str, Any]  # of report.json
  table: str  # the gap, in Markdown
  report: Path


def close_loop(
  out: Path,
  *,
  robot: str = recording.VIRTUAL,
  seed: int = 1,
  seconds: float = 12.0,
  reuse: bool = False,
) -> Closed:
  """Excites, records, identifies, simulates and compares; writes logs, model, report and table.

  Args:
    out: Folder to write.
    robot: Serial port, or "virtual".
    seed: Of the virtual robot's hidden properties.
    seconds: Length of a recorded motion [s].
    reuse: Takes the logs that an earlier loop left in the folder instead of moving the robot.

  Raises:
    FolderInUseError: Another process closes a loop in the folder.
    RuntimeError: The recorder or the robot did not keep up.
    ValueError: The logs cannot be identified from.
  """
  with lock_folder(out):
    return _close_loop(out, robot=robot, seed=seed, seconds=seconds, reuse=reuse)


def _close_loop(out: Path, *, robot: str, seed: int, seconds: float, reuse: bool) -> Closed:
  model, identified = out / "declared.xml", out / "identified"
  if reuse and not (out / "standing.npz").exists():
    raise ValueError(f"Found no recorded motions in {out}: leave --reuse out to record them.")
  if not reuse:
    moved = recording.record_motions(out, robot=robot, seed=seed, seconds=seconds)
    with atomic_path(out / "standing.npz") as partial:
      np.savez(partial, actions=moved["actions"], positions=moved["positions"])
  write_atomically(model, declared_model())
  standing = np.load(out / "standing.npz")
  content = sysid.identify(
    model,
    [out / f"{name}.mcap" for name in TRAIN],
    held=[out / f"{name}.mcap" for name in HELD],
    out=identified,
  )
  before = gap.suite_motion(None, standing["actions"])
  after = gap.suite_motion(identified / "effects.json", standing["actions"])
  table = gap.gap_table(standing["positions"], before, after, content)
  if robot == recording.VIRTUAL:
    table += gap.hidden_table(seed, content, identified / "details.json")
  write_atomically(out / "gap.md", table)
  return Closed(content, table, identified / "report.html")
