"""A map for people: the scene from above with the robot's trail.

Shapes: H height, W width.
"""

import cv2
import numpy as np

from nerf2real.suite.tasks import rewards
from nerf2real.suite.tasks.base import RobotTask

_FREE, _OCCUPIED, _OUTSIDE = (246, 243, 238), (120, 126, 135), (205, 208, 212)  # RGB
_TRAIL, _ROBOT, _GOAL, _BALL = (86, 180, 233), (0, 90, 150), (0, 158, 115), (219, 107, 26)
_MARGIN = 0.1  # m around the scene's extent
_CELL = 0.04  # m of a cell of the free floor


class TopDown:
  """The scene from above."""

  def __init__(self, task: RobotTask, height: int):
    """Draws the free floor.

    Args:
      task: The task, whose model is compiled.
      height: Height of the picture [pixel]; the width follows from the scene's extent.
    """
    self._task = task
    lower, upper = (np.asarray(corner, np.float64)[:2] for corner in task.scene.extent)
    self._lower, self._upper = lower - _MARGIN, upper + _MARGIN
    size = self._upper - self._lower
    self._scale = height / size[1]  # pixel/m
    self._background = self._draw_floor((height, max(1, round(size[0] * self._scale))))
    self._trail: list[np.ndarray] = []

  def _draw_floor(self, shape: tuple[int, int]) -> np.ndarray:
    x, y = (np.arange(self._lower[i] + _CELL / 2, self._upper[i], _CELL) for i in range(2))
    grid = np.stack(np.meshgrid(x, y[::-1]), axis=-1)
    free = np.asarray(self._task.scene.free_space.is_reachable(grid.reshape(-1, 2)))
    colors = np.where(free.reshape(grid.shape[:2])[..., None], _FREE, _OUTSIDE).astype(np.uint8)
    picture = cv2.resize(colors, shape[::-1], interpolation=cv2.INTER_NEAREST)
    cells = getattr(self._task.scene.free_space, "cells", None)
    if cells is not None:  # a map of matter too, not only of where the robot fits
      space = self._task.scene.free_space
      rows, columns = np.nonzero(cells == 0)
      corners = space.origin + space.resolution * np.stack([columns, rows], -1)
      for corner in corners:
        a, b = self._pixel(corner), self._pixel(corner + space.resolution)
        cv2.rectangle(picture, (a[0], b[1]), (b[0], a[1]), _OCCUPIED, -1)
    return picture

  def _pixel(self, xy: np.ndarray) -> tuple[int, int]:
    x = (xy[0] - self._lower[0]) * self._scale
    y = (self._upper[1] - xy[1]) * self._scale
    return round(float(x)), round(float(y))

  def restart(self) -> None:
    """Forgets the trail."""
    self._trail.clear()

  def draw(self) -> np.ndarray:
    """Returns the picture now, RGB uint8 [H, W, 3], and lengthens the trail."""
    task, picture = self._task, self._background.copy()
    self._trail.append(task.state.position[:2].copy())
    workspace = getattr(task, "workspace", None)
    if workspace is not None:
      for lower, upper, color in (
        (workspace.lower, workspace.upper, _OCCUPIED),
        (workspace.target - 0.5, workspace.target + 0.5, _GOAL),
      ):
        cv2.rectangle(picture, self._pixel(lower), self._pixel(upper), color, 2, cv2.LINE_AA)
    else:
      for goal in task.goals:  # type: ignore[attr-defined]
        present = np.array_equal(goal, task.goal)  # type: ignore[attr-defined]
        radius = round(rewards.SUCCESS_DISTANCE * self._scale)
        color = _GOAL if present else _OCCUPIED
        cv2.circle(picture, self._pixel(goal), radius, color, 3 if present else 1, cv2.LINE_AA)
    points = np.array([self._pixel(xy) for xy in self._trail], np.int32)
    cv2.polylines(picture, [points], False, _TRAIL, 2, cv2.LINE_AA)
    position, yaw = task.state.position[:2], task.state.yaw
    nose = position + 0.28 * np.array([np.cos(yaw), np.sin(yaw)])
    cv2.circle(picture, self._pixel(position), round(0.13 * self._scale), _ROBOT, -1, cv2.LINE_AA)
    cv2.line(picture, self._pixel(position), self._pixel(nose), _ROBOT, 3, cv2.LINE_AA)
    ball = getattr(task, "ball_position", None)
    if ball is not None:
      cv2.circle(picture, self._pixel(ball), round(0.12 * self._scale), _BALL, -1, cv2.LINE_AA)
    return picture
