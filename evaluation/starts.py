"""Where the trials of ball pushing start in a scene: as the simulation's task has it, without it.

A test compares the two. Navigation starts where `suite.protocols.scene_starts` says.
"""

from typing import Any

import numpy as np

from nerf2real.suite import protocols
from nerf2real.suite.gaits.walker import Pose
from nerf2real.suite.tasks.workspace import Workspace

_BALL_GRID = 0.05  # m, as suite.tasks.ball_push has it


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
