"""Top-down video frames of a task: the scene's floor, goals, the robot and its trail."""

import numpy as np

from nerf2real.core import palette
from nerf2real.core.floor_map import Extent
from nerf2real.scenes.geometry import floor_picture
from nerf2real.suite.tasks import rewards
from nerf2real.suite.tasks.base import RobotTask

_TRAIL, _GOAL, _OTHER_GOAL = palette.rgb(palette.SKY), palette.rgb(palette.GREEN), (120, 126, 135)
_BALL = (219, 107, 26)
_BALL_RADIUS = 0.12  # m
_MARGIN = 0.1  # m around the scene's extent


class TopDown:
  """The scene from above."""

  def __init__(self, task: RobotTask, height: int):
    """Draws the free floor.

    Args:
      task: The task, whose model is compiled.
      height: Height of the picture [pixel]; the width follows from the scene's extent.
    """
    self._task = task
    scene = task.scene
    self._floor = floor_picture.draw(scene.free_space, scene.extent, height=height, margin=_MARGIN)
    self._trail: list[np.ndarray] = []

  @property
  def extent(self) -> Extent:
    """What the picture shows: smallest and largest x and y [m]."""
    return self._floor.extent

  def restart(self) -> None:
    """Clears the trail."""
    self._trail.clear()

  def draw(self, density: np.ndarray | None = None) -> np.ndarray:
    """Returns the picture now, RGB uint8 [H, W, 3], and lengthens the trail.

    Args:
      density: Where a policy expects to be, on a grid of the whole extent; None: nothing is drawn.
    """
    task, floor = self._task, self._floor.copy()
    if density is not None:
      floor.heat(density)
    self._trail.append(task.state.position[:2].copy())
    workspace = getattr(task, "workspace", None)
    if workspace is not None:
      floor.box(workspace.lower, workspace.upper, _OTHER_GOAL)
      floor.box(workspace.target - 0.5, workspace.target + 0.5, _GOAL)
    else:
      for goal in task.goals:  # type: ignore[attr-defined]
        present = np.array_equal(goal, task.goal)  # type: ignore[attr-defined]
        color, width = (_GOAL, 3) if present else (_OTHER_GOAL, 1)
        floor.circle(goal, rewards.SUCCESS_DISTANCE, color, width=width)
    floor.path(np.array(self._trail), _TRAIL).robot(task.state.position, task.state.yaw)
    ball = getattr(task, "ball_position", None)
    if ball is not None:
      floor.disc(ball, _BALL_RADIUS, _BALL)
    return floor.picture
