"""Where the trials of ball pushing end: what each one lacked.

  python launch/evaluate.py --policy shipped --plant both --protocol ball --out out/ball
  python benchmarks/learning/ball_endings.py --folder out/ball

Reads an evaluation's episodes; nothing is run. Trials are counted by how far they came: the robot
was never at the ball; the ball was moved, but lies outside of the target cell at the end; the ball
came home. Beside each are its falls, the distances at the end, the time since the ball last moved
and the belief's error over the trial.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import harness
from nerf2real.evaluation import episodes
from nerf2real.evaluation.episodes import Episode
from nerf2real.suite import protocols
from nerf2real.suite.scene import open_scene
from nerf2real.suite.tasks.workspace import Workspace, find_workspace

_MOVED = 0.05  # m from its start at which a ball counts as moved; chosen: beyond rolling in place
_RESTS = 0.02  # m between points of a path, 0.2 s apart, below which a ball rests
STAGES = ("never_moved", "moved", "home")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings(harness.Options):
  """Which episodes."""

  folder: Path
  """Folder of an evaluation."""
  scene: Path | None = None
  """Folder of the scene bundle; the built-in room if not given."""


class Ending(NamedTuple):
  """How a trial ended."""

  stage: str  # one of STAGES
  outcome: str
  duration: float  # s
  robot_to_ball: float  # m
  ball_to_target: float  # m between the ball and the target cell's edge; 0 inside
  ball_to_edge: float  # m between the ball and the workspace's edge; negative outside
  rested: float  # s since the ball last moved
  error: float  # m, mean of the belief; NaN without one


def ending_of(episode: Episode, workspace: Workspace) -> Ending:
  """Returns how an episode of ball pushing ended."""
  times, ball = np.array(episode.ball_path)[:, 0], np.array(episode.ball_path)[:, 1:3]
  robot = np.array(episode.path)[-1, 1:3]
  moving = np.flatnonzero(np.linalg.norm(np.diff(ball, axis=0), axis=1) > _RESTS)
  last = times[moving[-1] + 1] if len(moving) else times[0]
  moved = bool((np.linalg.norm(ball - ball[0], axis=1) > _MOVED).any())
  outside = np.maximum(np.abs(ball[-1] - workspace.target) - protocols.CELL_SIZE / 2, 0.0)
  edge = np.minimum(ball[-1] - workspace.lower, workspace.upper - ball[-1]).min()
  return Ending(
    "home" if episode.success else STAGES[moved],
    episode.outcome,
    episode.duration,
    float(np.linalg.norm(robot - ball[-1])),
    float(np.linalg.norm(outside)),
    float(edge),
    float(times[-1] - last),
    float("nan") if episode.localisation_error is None else episode.localisation_error,
  )


def summary(endings: Sequence[Ending]) -> dict[str, harness.Value]:
  """Figures of some trials of one stage: medians but for counts."""
  found: dict[str, harness.Value] = {
    "trials": len(endings),
    "falls": sum(ending.outcome == episodes.FALL for ending in endings),
    "lost": sum(ending.outcome == episodes.LOST for ending in endings),
  }
  for name in Ending._fields[2:]:
    found[name] = float(np.median([getattr(ending, name) for ending in endings]))
  return found


def main(settings: Settings) -> None:
  """Reports the endings by plant, group of trials and stage."""
  workspace = find_workspace(open_scene(settings.scene))
  store = episodes.Store(settings.folder)
  found: dict[str, list[Ending]] = {}
  for episode in episodes.select(store.episodes, protocol="ball"):
    ending = ending_of(episode, workspace)
    plant = episode.setting.plant_id if episode.setting.plant == "virtual" else "simulation"
    found.setdefault(f"{plant}, {episode.group}, {ending.stage}", []).append(ending)
  if not found:
    raise SystemExit(f"{settings.folder} holds no episodes of ball pushing.")
  rows = {name: summary(endings) for name, endings in sorted(found.items())}
  details = {name: [ending._asdict() for ending in endings] for name, endings in found.items()}
  harness.finish("ball_endings", rows, settings, seed=0, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
