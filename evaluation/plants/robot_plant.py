"""What a robot and the virtual robot share as plants: both are reached through `real`."""

from pathlib import Path
from typing import Any

import dm_env
import numpy as np

from nerf2real.evaluation.plants.plant import Plant, Trial
from nerf2real.evaluation.settings import EvaluationSettings
from nerf2real.real.recorder.recorder import Recorder
from nerf2real.real.safety.monitor import Reason
from nerf2real.suite import protocols
from nerf2real.suite.pose import Pose
from nerf2real.suite.protocols import BALL, BallTrial
from nerf2real.suite.tasks.workspace import find_workspace


class RobotPlant(Plant):
  """Episodes in an environment of `real`, which a subclass connects to."""

  _environment: Any

  def __init__(self, scene: Any, settings: EvaluationSettings, *, record: Path | None):
    """Finds the starts in the scene and opens the recording.

    Args:
      scene: An opened bundle of the room.
      settings: The evaluation's.
      record: Where the run is recorded; not recorded if None.
    """
    super().__init__(scene, settings)
    self._starts = protocols.scene_starts(scene)
    self._workspace = find_workspace(scene) if self.protocol == BALL else None
    self._recorder = None if record is None else Recorder(record)

  def _abandon_recording(self) -> None:
    """Ends the recording of a robot that was not reached: it holds nothing."""
    if self._recorder is not None:
      self._recorder.abandon()

  @property
  def environment(self) -> dm_env.Environment:
    return self._environment

  @property
  def goal(self) -> np.ndarray:
    return self._environment.goal

  @property
  def time_limit(self) -> float:
    return float(self._environment.time_limit)

  def _places(self, trial: Trial) -> tuple[Pose, np.ndarray | None]:
    """Sets a trial's goal; returns the start of the robot and, for ball pushing, of the ball."""
    if isinstance(trial, BallTrial):
      assert self._workspace is not None
      robot, ball = self._workspace.starts(trial, self.scene.free_space)
      return Pose.of(robot, trial.robot_yaw), ball
    self._environment.set_goal(trial.goal)
    return Pose.of(self._starts[trial.position], trial.yaw), None

  def _stopped_by_a_fall(self) -> bool:
    stop = self._environment.stop
    return stop is not None and stop.reason == Reason.FALL

  def stopped(self) -> str:
    stop = self._environment.stop
    return "" if stop is None else f"{stop.reason}: {stop.detail}"
