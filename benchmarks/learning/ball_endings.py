"""Where the trials of ball pushing end: what each one lacked.

  python launch/evaluate.py --policy shipped --plant both --protocol ball --out out/ball
  python benchmarks/learning/ball_endings.py --folder out/ball

Reads an evaluation's episodes; nothing is run. Trials are counted by how far they came: the robot
was never at the ball; the ball was moved, but lies outside of the target cell at the end; the ball
came home. Beside each are its falls, the distances at the end, the time since the ball last moved
and since the robot last went anywhere, the share of pictures that show the ball and the belief's
error over the trial.
"""

import base64
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks import harness
from nerf2real.evaluation import episodes
from nerf2real.evaluation.episodes import Episode
from nerf2real.scenes.geometry.free_space import FreeSpaceMap
from nerf2real.suite import protocols
from nerf2real.suite.scene import open_scene
from nerf2real.suite.tasks.workspace import Workspace, find_workspace

_MOVED = 0.05  # m from its start at which a ball counts as moved; chosen: beyond rolling in place
_RESTS = 0.02  # m between points of a path, 0.2 s apart, below which a ball rests
_STAYS = 0.1  # m from where a robot ends within which it goes nowhere; chosen: shorter than a foot
# Of an orange pixel, red over green, green over blue and red [8-bit levels]; chosen: below those of
# the ball in simulation (181, 89, 21) and in the true room (207, 97, 22), above the carpet's.
_ORANGE = (1.7, 2.2, 110)
_PIXELS = 4  # orange ones from which a picture shows the ball; chosen
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
  ball_to_matter: float  # m between the ball's centre and what is not free floor
  rested: float  # s since the ball last moved
  stayed: float  # s since the robot came to where it ended
  in_view: float  # share of the kept pictures that show the ball; NaN without pictures
  error: float  # m, mean of the belief; NaN without one


def ending_of(episode: Episode, workspace: Workspace, floor: FreeSpaceMap) -> Ending:
  """Returns how an episode of ball pushing ended."""
  times, ball = np.array(episode.ball_path)[:, 0], np.array(episode.ball_path)[:, 1:3]
  path = np.array(episode.path)
  robot = path[-1, 1:3]
  moving = np.flatnonzero(np.linalg.norm(np.diff(ball, axis=0), axis=1) > _RESTS)
  last = times[moving[-1] + 1] if len(moving) else times[0]
  elsewhere = np.flatnonzero(np.linalg.norm(path[:, 1:3] - robot, axis=1) > _STAYS)
  came = path[elsewhere[-1] + 1, 0] if len(elsewhere) else path[0, 0]
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
    clearance(floor, ball[-1]),
    float(times[-1] - last),
    float(path[-1, 0] - came),
    in_view(episode),
    float("nan") if episode.localisation_error is None else episode.localisation_error,
  )


def clearance(floor: FreeSpaceMap, place: np.ndarray) -> float:
  """Returns the distance of a place [2] on the map from what is not free floor [m]."""
  row, column = np.clip(floor.cell_of(place), 0, np.array(floor.cells.shape) - 1)
  return float(floor.clearance[row, column])


def in_view(episode: Episode) -> float:
  """Returns the share of an episode's kept pictures that show the ball; NaN without pictures."""
  pictures = [moment.picture for moment in episode.moments if moment.picture]
  return float(np.mean([_shows_ball(picture) for picture in pictures])) if pictures else np.nan


def _shows_ball(picture: str) -> bool:
  image: Any = cv2.imdecode(np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR)
  blue, green, red = np.moveaxis(image.astype(float), -1, 0)
  red_over_green, green_over_blue, least_red = _ORANGE
  orange = (red > red_over_green * green) & (green > green_over_blue * blue) & (red > least_red)
  return int(orange.sum()) >= _PIXELS


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
  scene = open_scene(settings.scene)
  workspace = find_workspace(scene)
  store = episodes.Store(settings.folder)
  found: dict[str, list[Ending]] = {}
  for episode in episodes.select(store.episodes, protocol="ball"):
    ending = ending_of(episode, workspace, scene.free_space)
    plant = episode.setting.plant_id if episode.setting.plant == "virtual" else "simulation"
    found.setdefault(f"{plant}, {episode.group}, {ending.stage}", []).append(ending)
  if not found:
    raise SystemExit(f"{settings.folder} holds no episodes of ball pushing.")
  rows = {name: summary(endings) for name, endings in sorted(found.items())}
  details = {name: [ending._asdict() for ending in endings] for name, endings in found.items()}
  harness.finish("ball_endings", rows, settings, seed=0, details=details)


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
