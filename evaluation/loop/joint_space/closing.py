"""Closes the loop once: excite a robot, record, identify, simulate with the effects, compare."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerf2real.core.files import atomic_path, write_atomically
from nerf2real.evaluation.loop import naming
from nerf2real.evaluation.loop.joint_space import gap
from nerf2real.evaluation.loop.robot import machines, recording
from nerf2real.evaluation.loop.settings import LoopSettings, claim
from nerf2real.real.loading import Connection
from nerf2real.suite.effects import read_effects


class Closed(NamedTuple):
  """What a loop gave."""

  content: dict[str, Any]  # of report.json
  table: str  # the gap, in Markdown
  report: Path


def close_loop(settings: LoopSettings) -> Closed:
  """Excites, records, identifies, simulates and compares; writes logs, model, report and table.

  Logs and findings that an interrupted loop left in the folder are kept.

  Raises:
    RuntimeError: The recorder or the robot did not keep up.
    ValueError: The logs cannot be identified from, or the folder is another loop's.
  """
  altered = machines.hidden_effects(settings.hidden, settings.seed)
  claim(settings)
  out, seconds = settings.out, settings.seconds
  if settings.robot == recording.VIRTUAL:
    noise = machines.noise_beside(settings.reference)
    with machines.virtual_robot(settings.seed, altered, noise=noise) as (connection, virtual):
      _record(out, connection, virtual, seconds)
  else:
    _record(out, Connection(port=settings.robot, offsets=settings.offsets), None, seconds)
  standing = np.load(out / "standing.npz")
  named = naming.name(out / "identified", out, settings.reference)
  before = gap.suite_motion(None, standing["actions"])
  after = gap.suite_motion(named.effects_path, standing["actions"])
  table = gap.gap_table(standing["positions"], before, after, named.content)
  if settings.robot == recording.VIRTUAL:
    table += gap.hidden_table(settings.seed, named.content, out / "identified" / "details.json")
    table += "".join(f"\nUndeclared: {effect}.\n" for effect in altered)
    zeros = gap.with_hidden_zeros(settings.seed, read_effects(named.effects_path))
    known = gap.suite_motion(zeros, standing["actions"])
    mean = gap.gaps_between(standing["positions"], known).mean()
    table += (
      "\nOn the floor, with the hidden zeros of the encoders in place of those found, of which a"
      f" robot held in the air shows little: mean {mean:.3f} deg.\n"
    )
  write_atomically(out / "gap.md", table)
  return Closed(named.content, table, out / "identified" / "report.html")


def _record(out: Path, connection: Connection, virtual: Any, seconds: float) -> None:
  """Records what is missing in the folder."""
  recording.record_stand(out, connection, virtual, seconds=seconds)
  if not (out / "standing.npz").exists():
    moved = recording.record_standing(connection, virtual, seconds=seconds)
    with atomic_path(out / "standing.npz") as path:
      np.savez(path, **moved)  # type: ignore[arg-type]
