"""Where the trials of a protocol start in a scene: as the simulation's tasks have it, without them.

A test compares the two.
"""

from typing import Any

import numpy as np

from suite import protocols
from suite.gaits.walker import Pose
from suite.tasks.workspace import Workspace

_GRID = 0.1  # m, as suite.tasks.nerf_nav has it
_BALL_GRID = 0.05  # m, as suite.tasks.ball_push has it


def navigation_starts(scene: Any) -> np.ndarray:
  """Returns the start positions of navigation [3, 2] [m]."""
  lower, upper = (np.asarray(corner, np.float64)[:2] for corner in scene.extent)
  x, y = (np.arange(lower[i] + _GRID / 2, upper[i], _GRID) for i in range(2))
  points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
  free = points[np.asarray(scene.free_space.is_reachable(points), bool)]
  goals = np.asarray(scene.goals, np.float64).reshape(-1, 2)
  return protocols.navigation_starts(free, goals)


def ball_start(
  scene: Any, workspace: Workspace, trial: protocols.BallTrial
) -> tuple[Pose, np.ndarray]:
  """Returns where robot and ball [2] start in a trial of ball pushing."""
  robot = _nearest_free(scene, workspace, workspace.center + trial.robot_xy)
  ball = _nearest_free(scene, workspace, workspace.center + trial.ball_xy)
  return Pose(float(robot[0]), float(robot[1]), trial.robot_yaw), ball


def _nearest_free(scene: Any, workspace: Workspace, xy: np.ndarray) -> np.ndarray:
  if scene.free_space.is_reachable(xy[None])[0]:
    return xy
  side = np.arange(0, protocols.WORKSPACE_SIZE, _BALL_GRID) + _BALL_GRID / 2
  points = workspace.lower + np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
  points = points[np.asarray(scene.free_space.is_reachable(points), bool)]
  return points[np.argmin(np.linalg.norm(points - xy, axis=1))]
