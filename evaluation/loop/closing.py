"""Closes the loop once: excite a robot, record, identify, simulate with the effects, compare."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

<<<<<<< HEAD
from nerf2real import sysid
from nerf2real.core.files import atomic_path, write_atomically
from nerf2real.core.folder_lock import lock_folder
from nerf2real.evaluation.loop import gap, recording
from nerf2real.evaluation.loop.motions import HELD, TRAIN, declared_model
=======
from nerf2real.core.files import atomic_path, write_atomically
from nerf2real.evaluation.loop import gap, machines, naming, recording
from nerf2real.evaluation.loop.settings import LoopSettings, claim
from nerf2real.real.loading import Connection
>>>>>>> main


class Closed(NamedTuple):
  """What a loop gave."""

  content: dict[str, Any]  # of report.json
  table: str  # the gap, in Markdown
  report: Path


def close_loop(settings: LoopSettings) -> Closed:
  """Excites, records, identifies, simulates and compares; writes logs, model, report and table.

  Logs and findings that an interrupted loop left in the folder are kept.

  Raises:
    FolderInUseError: Another process closes a loop in the folder.
    RuntimeError: The recorder or the robot did not keep up.
    ValueError: The logs cannot be identified from, or the folder is another loop's.
  """
<<<<<<< HEAD
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
=======
  altered = machines.hidden_effects(settings.hidden, settings.seed)
  claim(settings)
  out, seconds = settings.out, settings.seconds
  if settings.robot == recording.VIRTUAL:
    with machines.virtual_robot(settings.seed, altered) as (connection, virtual):
      _record(out, connection, virtual, seconds)
  else:
    _record(out, Connection(port=settings.robot), None, seconds)
>>>>>>> main
  standing = np.load(out / "standing.npz")
  named = naming.name(out / "identified", out, settings.reference)
  before = gap.suite_motion(None, standing["actions"])
<<<<<<< HEAD
  after = gap.suite_motion(identified / "effects.json", standing["actions"])
  table = gap.gap_table(standing["positions"], before, after, content)
  if robot == recording.VIRTUAL:
    table += gap.hidden_table(seed, content, identified / "details.json")
  write_atomically(out / "gap.md", table)
  return Closed(content, table, identified / "report.html")
=======
  after = gap.suite_motion(named.effects_path, standing["actions"])
  table = gap.gap_table(standing["positions"], before, after, named.content)
  if settings.robot == recording.VIRTUAL:
    table += gap.hidden_table(settings.seed, named.content, out / "identified" / "details.json")
    table += "".join(f"\nUndeclared: {effect}.\n" for effect in altered)
  write_atomically(out / "gap.md", table)
  return Closed(named.content, table, out / "identified" / "report.html")


def _record(out: Path, connection: Connection, virtual: Any, seconds: float) -> None:
  """Records what is missing in the folder."""
  recording.record_stand(out, connection, virtual, seconds=seconds)
  if not (out / "standing.npz").exists():
    moved = recording.record_standing(connection, virtual, seconds=seconds)
    with atomic_path(out / "standing.npz") as path:
      np.savez(path, **moved)  # type: ignore[arg-type]
>>>>>>> main
