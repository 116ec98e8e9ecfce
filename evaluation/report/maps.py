"""The paths of episodes over the scene from above."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nerf2real.core import palette
from nerf2real.core.floor_map import FloorMap
from nerf2real.evaluation.episodes import COLLISION, FALL, LOST, STOPPED, SUCCESS, Episode
from nerf2real.scenes.geometry import floor_picture
from nerf2real.suite import protocols
from nerf2real.suite.tasks import rewards

COLORS = {
  SUCCESS: palette.GREEN,
  COLLISION: palette.VERMILION,
  FALL: palette.PURPLE,
  LOST: palette.BLUE,
  STOPPED: "#828282",
}
_START = (40, 40, 40)


def draw_floor(scene: Any, *, height: int) -> FloorMap:
  """Draws the free floor of a scene, by its extent and free space; height in pixels."""
  return floor_picture.draw(scene.free_space, scene.extent, height=height)


def draw_paths(floor: FloorMap, found: Sequence[Episode]) -> np.ndarray:
  """Returns the floor with the paths of episodes, coloured by how they ended, uint8 [H, W, 3]."""
  floor = floor.copy()
  for goal, of_ball in sorted({(e.goal, bool(e.ball_path)) for e in found}):
    if of_ball:
      half = protocols.CELL_SIZE / 2
      floor.box(np.array(goal) - half, np.array(goal) + half, palette.rgb(COLORS[SUCCESS]))
    else:
      floor.circle(np.array(goal), rewards.SUCCESS_DISTANCE, palette.rgb(COLORS[SUCCESS]))
  for episode in sorted(found, key=lambda e: not e.success):  # failures on top: they are few
    path = np.array(episode.path, np.float64).reshape(-1, 4)
    if not len(path):
      continue
    color = palette.rgb(COLORS[episode.outcome])
    if episode.ball_path:
      ball = np.array(episode.ball_path)[:, 1:3]
      floor.path(ball, palette.rgb(palette.ORANGE), width=1)
    floor.path(path[:, 1:3], color).disc(path[0, 1:3], 0.03, _START)
    if not episode.success:
      floor.disc(path[-1, 1:3], 0.05, color)
  return floor.scale_bar().picture
