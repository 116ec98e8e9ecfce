"""The scene from above, with where robots went, and with what a policy believed.

Shapes: H height, W width; row 0 is the largest y.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from nerf2real.evaluation.episodes import COLLISION, FALL, LOST, STOPPED, SUCCESS, Episode
from nerf2real.suite import protocols
from nerf2real.suite.tasks import rewards

# RGB, Okabe and Ito's palette.
COLORS = {
  SUCCESS: (0, 158, 115),
  COLLISION: (213, 94, 0),
  FALL: (204, 121, 167),
  LOST: (0, 114, 178),
  STOPPED: (130, 130, 130),
}
_FREE, _MATTER, _OTHER = (246, 243, 238), (120, 126, 135), (208, 211, 215)
_CELL = 0.04  # m
_FINE = 4  # drawn positions are fractions of a pixel: 4 bits

Extent = tuple[float, float, float, float]  # x from, x to, y from, y to [m]


class Map:
  """A picture of the floor in which places can be drawn."""

  def __init__(self, scene: Any, *, height: int = 420):
    """Draws the free floor.

    Args:
      scene: A bundle: its extent and free space are used.
      height: Height of the picture [pixel].
    """
    lower, upper = (np.asarray(corner, np.float64)[:2] for corner in scene.extent)
    self.extent: Extent = (lower[0], upper[0], lower[1], upper[1])
    self.scale = height / (upper[1] - lower[1])  # pixel/m
    width = round((upper[0] - lower[0]) * self.scale)
    x, y = (np.arange(lower[i] + _CELL / 2, upper[i], _CELL) for i in range(2))
    points = np.stack(np.meshgrid(x, y[::-1]), axis=-1)
    flat = points.reshape(-1, 2)
    free = np.asarray(scene.free_space.is_reachable(flat), bool).reshape(points.shape[:2])
    colors = np.where(free[..., None], _FREE, _OTHER).astype(np.uint8)
    cells = getattr(scene.free_space, "cells", None)
    if cells is not None:  # matter is known too, not only where the robot fits
      index = scene.free_space.cell_of(flat)
      inside = np.all((index >= 0) & (index < cells.shape), axis=-1)
      matter = np.zeros(len(flat), bool)
      matter[inside] = cells[index[inside, 0], index[inside, 1]] == 0
      colors[matter.reshape(points.shape[:2])] = _MATTER
    self.background = cv2.resize(colors, (width, height), interpolation=cv2.INTER_NEAREST)

  def pixels(self, xy: np.ndarray) -> np.ndarray:
    """Returns pixels [N, 2] of places [N, 2], in sixteenths."""
    x = (np.asarray(xy, np.float64)[:, 0] - self.extent[0]) * self.scale
    y = (self.extent[3] - np.asarray(xy, np.float64)[:, 1]) * self.scale
    return np.rint(np.stack([x, y], -1) * 2**_FINE).astype(np.int32)

  def line(self, picture: np.ndarray, xy: np.ndarray, color: Any, *, width: int = 2) -> None:
    """Draws a line through places [N, 2]."""
    cv2.polylines(picture, [self.pixels(xy)], False, color, width, cv2.LINE_AA, _FINE)

  def disc(
    self, picture: np.ndarray, xy: np.ndarray, radius: float, color: Any, *, width: int = -1
  ) -> None:
    """Draws a disc, or a circle, of a radius [m] at a place [2]."""
    center = self.pixels(np.asarray(xy)[None])[0]
    size = round(radius * self.scale * 2**_FINE)
    point = (int(center[0]), int(center[1]))
    cv2.circle(picture, point, size, color, width, cv2.LINE_AA, _FINE)

  def square(self, picture: np.ndarray, xy: np.ndarray, side: float, color: Any) -> None:
    """Draws the outline of a square of a side [m] about a place [2]."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * side / 2
    self.line(picture, np.asarray(xy) + corners, color)


def draw_paths(floor: Map, found: Sequence[Episode]) -> np.ndarray:
  """Returns the floor with the paths of episodes, coloured by how they ended, uint8 [H, W, 3]."""
  picture = floor.background.copy()
  for goal, of_ball in sorted({(e.goal, bool(e.ball_path)) for e in found}):
    if of_ball:
      floor.square(picture, np.array(goal), protocols.CELL_SIZE, COLORS[SUCCESS])
    else:
      floor.disc(picture, np.array(goal), rewards.SUCCESS_DISTANCE, COLORS[SUCCESS], width=2)
  for episode in sorted(found, key=lambda e: not e.success):  # failures on top: they are few
    path = np.array(episode.path, np.float64).reshape(-1, 4)
    if not len(path):
      continue
    color = COLORS[episode.outcome]
    if episode.ball_path:
      ball = np.array(episode.ball_path)[:, 1:3]
      floor.line(picture, ball, (230, 159, 0), width=1)
    floor.line(picture, path[:, 1:3], color)
    floor.disc(picture, path[0, 1:3], 0.03, (40, 40, 40))
    if not episode.success:
      floor.disc(picture, path[-1, 1:3], 0.05, color)
  return picture
