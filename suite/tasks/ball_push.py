"""Ball pushing: move a basketball into a corner of a 3 x 3 m workspace.

Byravan et al. 2022, NeRF2Real, section "Tasks" and appendix "Rewards".
"""

import functools
from typing import Any

import numpy as np
from dm_control import composer

from nerf2real.core.geometry import rotations
from nerf2real.suite import protocols
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose
from nerf2real.suite.sensors.camera import RobotCamera
from nerf2real.suite.tasks import catalogue, rewards, touch
from nerf2real.suite.tasks.ball import Ball
from nerf2real.suite.tasks.base import RobotTask
from nerf2real.suite.tasks.privileged import Quantity
from nerf2real.suite.tasks.settings import TaskSettings
from nerf2real.suite.tasks.workspace import find_workspace

NAME = catalogue.BALL_PUSH
TIME_LIMIT = catalogue.TIME_LIMITS[NAME]  # s
FALL = "fall"
BALL_IN_FRONT = 0.5  # share of episodes with the ball just in front of the robot (paper)
# m ahead of and beside the robot's torso, when it starts in front; chosen: a few steps away.
_AHEAD, _ASIDE = (0.25, 0.45), 0.08
_MAX_ATTEMPTS = 100


class BallPush(RobotTask):
  """Push the ball into the target corner. Ends on a fall."""

  weights = rewards.BALL_WEIGHTS

  def __init__(
    self,
    scene: Any,
    *,
    camera: RobotCamera | None = None,
    settings: TaskSettings | None = None,
  ):
    """Builds the task; see `RobotTask`.

    Args:
      scene: The scene's bundle.
      camera: The robot's camera.
      settings: Settings of the task.
    """
    super().__init__(
      scene,
      camera=camera,
      settings=settings or TaskSettings(time_limit=TIME_LIMIT),
      head_pan_limit=constants.BALL_PUSHING_HEAD_PAN,
    )
    self.workspace = find_workspace(scene)
    self.ball = Ball()
    self._arena.add_free_entity(self.ball)
    self.ball_start: tuple[float, float] | None = None  # if set, the ball starts here

  def set_start(self, start: Pose | None, *, ball_xy: tuple[float, float] | None = None) -> None:
    """Fixes where robot and ball start in the episodes to come; None draws them again."""
    self.start, self.ball_start = start, ball_xy

  def set_trial(self, trial: protocols.BallTrial) -> None:
    """Fixes the start to that of a trial of an evaluation protocol.

    Where the room's furniture stands in the way, robot and ball start at the nearest free place.
    """
    robot, ball = self.workspace.starts(trial, self.scene.free_space)
    self.set_start(
      Pose.of(robot, trial.robot_yaw),
      ball_xy=(float(ball[0]), float(ball[1])),
    )

  def after_compile(self, physics: Any, random_state: np.random.RandomState) -> None:
    super().after_compile(physics, random_state)
    model = self._model
    self._ball_id = int(physics.bind(self.ball.geom).element_id)
    joint = model.body_jntadr[model.geom_bodyid[self._ball_id]]
    self._ball_qpos, self._ball_dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])

  @property
  def ball_position(self) -> np.ndarray:
    """Centre of the ball [3] in the world [m]."""
    return self._data.qpos[self._ball_qpos : self._ball_qpos + 3].copy()

  @property
  def ball_velocity(self) -> np.ndarray:
    """Velocity of the ball [3] in the world [m/s]."""
    return self._data.qvel[self._ball_dof : self._ball_dof + 3].copy()

  def _ball_geom(self) -> str | None:
    return self.ball.geom.full_identifier

  def _place(self, random_state: np.random.RandomState) -> None:
    in_front = random_state.uniform() < BALL_IN_FRONT
    for attempt in range(2 * _MAX_ATTEMPTS):
      if attempt == _MAX_ATTEMPTS:  # there is no room in front of the robot: beside it there may be
        in_front = False
      self.put_ball((0.0, 0.0), height=10.0)  # out of the way while the robot is placed
      self._stand_somewhere(
        lambda: Pose.of(self._free_place(random_state), random_state.uniform(-np.pi, np.pi))
      )
      if self.ball_start is not None:
        self.put_ball(self.ball_start)
        return
      self.put_ball(self._in_front(random_state) if in_front else self._free_place(random_state))
      if not self._ball_touches_anything():
        return
    raise composer.EpisodeInitializationError(
      f"Found no place for robot and ball in {2 * _MAX_ATTEMPTS} attempts: the workspace of the "
      f"scene {getattr(self.scene, 'name', '')!r} is too full."
    )

  def _free_place(self, random_state: np.random.RandomState) -> np.ndarray:
    """Draws a free place of the workspace [2]."""
    for _ in range(_MAX_ATTEMPTS):
      xy = random_state.uniform(self.workspace.lower, self.workspace.upper)
      if self.scene.free_space.is_reachable(xy):
        return xy
    places = self._free_places
    return places[random_state.randint(len(places))]

  @functools.cached_property
  def _free_places(self) -> np.ndarray:
    """The places [N, 2] of a grid over the workspace at which a robot can stand."""
    places = self.workspace.places()
    return places[np.asarray(self.scene.free_space.is_reachable(places), bool)]

  def _in_front(self, random_state: np.random.RandomState) -> np.ndarray:
    root = self._indices.root_qpos
    yaw = rotations.yaw_of(rotations.matrix_from_quaternion(self._data.qpos[root + 3 : root + 7]))
    ahead, aside = random_state.uniform(*_AHEAD), random_state.uniform(-_ASIDE, _ASIDE)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-forward[1], forward[0]])
    return self._data.qpos[root : root + 2] + ahead * forward + aside * left

  def put_ball(self, xy: Any, *, height: float | None = None) -> None:
    """Writes the ball's place [2], and height if it is not on the floor, into qpos [m]."""
    radius = self._model.geom_size[self._ball_id, 0]
    address = self._ball_qpos
    self._data.qpos[address : address + 2] = xy
    self._data.qpos[address + 2] = radius if height is None else height
    self._data.qpos[address + 3 : address + 7] = (1, 0, 0, 0)

  def _ball_touches_anything(self) -> bool:
    """Returns whether the ball, where it is now, touches more than the floor."""
    touch.collide(self._model, self._data)
    floor = self._model.geom(self._arena.floor.full_identifier).id
    pairs = self._data.contact.geom
    touching = (pairs == self._ball_id).any(axis=1) & ~(pairs == floor).any(axis=1)
    return bool(touching.any()) or not self.workspace.contains(self.ball_position[:2])

  def _goal_observation(self) -> np.ndarray:
    return self.workspace.target

  def _goal_position(self) -> np.ndarray:
    return self.workspace.target

  def _compute_rewards(self) -> dict[str, float]:
    ball, state = self.ball_position, self._state
    return rewards.ball_task(
      state.yaw_speed,
      state.feet_velocity,
      goal_from_ball=self.workspace.target - ball[:2],
      ball_from_robot=ball[:2] - state.position[:2],
      ball_velocity=self.ball_velocity,
      robot_velocity=state.velocity,
      joints=state.joints,
      reference=constants.REFERENCE_POSE,
      joint_range=self._joint_range,
    )

  def _reached(self) -> bool:
    return self.workspace.in_target(self.ball_position[:2])

  def _failure(self) -> str | None:
    return FALL if self.fallen else None

  def _privileged(self) -> dict[str, Quantity]:
    def ball_from_robot() -> np.ndarray:
      return (self.ball_position - self._state.position) @ self._state.aligned

    def goal_from_ball() -> np.ndarray:
      return self.relative(self.workspace.target) - self.relative(self.ball_position[:2])

    return {
      "ball_position": Quantity(3, lambda: self.ball_position),
      "ball_velocity": Quantity(3, lambda: self.ball_velocity @ self._state.aligned),
      "ball_from_robot": Quantity(3, ball_from_robot),
      "goal_from_ball": Quantity(2, goal_from_ball),
    }
