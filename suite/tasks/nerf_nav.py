"""Navigation and obstacle avoidance: walk to one of three goals without touching the room.

Byravan et al. 2022, NeRF2Real, section "Tasks" and appendix "Rewards". The goal reaches the policy
as (x, y) in the scene's world frame; where the robot is does not: it has to see that.
"""

import functools
from typing import Any

import numpy as np

from nerf2real.suite import protocols
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.sensors.camera import RobotCamera
from nerf2real.suite.tasks import catalogue, rewards
from nerf2real.suite.tasks.base import RobotTask
from nerf2real.suite.tasks.settings import TaskSettings

NAME = catalogue.NERF_NAV
TIME_LIMIT = catalogue.TIME_LIMITS[NAME]  # s
FALL, COLLISION = "fall", "collision"


class NerfNav(RobotTask):
  """Walk to a goal. Ends on a fall and on touching the room with anything but the feet."""

  weights = rewards.NAVIGATION_WEIGHTS

  def __init__(
    self, scene: Any, *, camera: RobotCamera | None = None, settings: TaskSettings | None = None
  ):
    """Builds the task; see `RobotTask`."""
    super().__init__(scene, camera=camera, settings=settings or TaskSettings(time_limit=TIME_LIMIT))
    self._goals = np.asarray(scene.goals, np.float64).reshape(-1, 2)
    if not len(self._goals):
      raise ValueError("The scene has no goals: scene.json needs at least one (x, y) in `goals`.")
    self.goal_index: int | None = None  # if set, every episode has this goal (evaluation)
    self._goal = self._goals[0]

  @property
  def goals(self) -> np.ndarray:
    """The goals [G, 2] in the world [m]."""
    return self._goals.copy()

  @property
  def goal(self) -> np.ndarray:
    """The present goal [2] in the world [m]."""
    return self._goal.copy()

  def next_goal(self) -> None:
    """Goes on to the next goal within the episode, as after one that was reached."""
    present = int(np.argmin(np.linalg.norm(self._goals - self._goal, axis=1)))
    self._goal = self._goals[(present + 1) % len(self._goals)]
    self.success, self.success_time = False, float("nan")

  def set_start(self, start: Pose | None, *, goal_index: int | None = None) -> None:
    """Fixes the start pose and the goal of the episodes to come; None draws them again."""
    if goal_index is not None and not 0 <= goal_index < len(self._goals):
      raise ValueError(
        f"Unknown goal {goal_index}: the scene has {len(self._goals)} goals, counted from 0."
      )
    self.start, self.goal_index = start, goal_index

  def set_trial(self, trial: protocols.NavigationTrial) -> None:
    """Fixes start pose, goal and camera gain to those of a trial of an evaluation protocol."""
    start = Pose.of(self.evaluation_starts[trial.position], trial.yaw)
    self.set_start(start, goal_index=trial.goal)
    if self.robot_camera is not None:
      self.robot_camera.set_gain(trial.camera_gain)

  @functools.cached_property
  def evaluation_starts(self) -> np.ndarray:
    """The start positions of the evaluation protocols [3, 2] in the world [m]."""
    return protocols.scene_starts(self.scene)

  def _place(self, random_state: np.random.RandomState) -> None:
    drawn = random_state.randint(len(self._goals))
    self._goal = self._goals[drawn if self.goal_index is None else self.goal_index]
    rng = np.random.default_rng(random_state.randint(2**31))

    def draw() -> Pose:
      return Pose(*self.scene.free_space.sample(rng, 1)[0])

    self._stand_somewhere(draw)

  def _goal_observation(self) -> np.ndarray:
    return self._goal

  def _goal_position(self) -> np.ndarray:
    return self._goal

  def _compute_rewards(self) -> dict[str, float]:
    return rewards.navigation_task(
      self._state.yaw_speed,
      self._state.feet_velocity,
      goal=self.relative(self._goal),
      joints=self._state.joints,
      reference=constants.REFERENCE_POSE,
      joint_range=self._joint_range,
    )

  @property
  def goal_distance(self) -> float:
    """Distance of the torso from the goal on the floor [m]."""
    return float(np.hypot(*(self._goal - self._state.position[:2])))

  def _reached(self) -> bool:
    return self.goal_distance <= rewards.SUCCESS_DISTANCE

  def _failure(self) -> str | None:
    if self.touches_scene:
      return COLLISION
    return FALL if self.fallen else None
