"""The scripted walker: the gait, steered to a goal over a path, or pushing a ball.

It is a baseline that needs no training: its pose is given to it
(privileged in simulation, an observer's on the virtual robot) or else by dead reckoning: its own
turning rate and the steps that it has commanded.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerf2real.suite.gaits.entrained import EntrainedGait
from nerf2real.suite.gaits.gaze import Gaze, view_of
from nerf2real.suite.gaits.planner import Planner
from nerf2real.suite.gaits.pushing import Push, PushSettings
from nerf2real.suite.gaits.walk import Command, Gait, GaitSettings
from nerf2real.suite.op3 import constants
from nerf2real.suite.pose import Pose

_TIMESTEP = constants.CONTROL_TIMESTEP
_HEAD = [constants.JOINT_NAMES.index(name) for name in ("head_pan", "head_tilt")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SteeringSettings:
  """Steering of the walker; chosen: it reached the goals in simulation."""

  speed: float = 0.22
  """m/s at full stride, for dead reckoning."""
  lookahead: float = 0.3
  """m along the path that it aims at."""
  turn_gain: float = 1.2
  """Turning step per rad of heading error."""
  turn_first: float = 0.7
  """rad of heading error from which it turns on the spot."""
  arrival: float = 0.08
  """m from the goal at which it stops."""
  replan: float = 1.0
  """s between paths."""
  circling: float = 0.15
  """m along a path around the ball that it aims at: a path as narrow leaves less."""
  push: PushSettings = PushSettings()
  """Of a push."""
  head_tilt: float | None = None
  """rad of the head's tilt; None: as in the reference pose, which sees the floor ahead."""
  watches_ball: bool = False
  """Whether the head follows the ball, and looks for it first."""


class Walker:
  """Walks to goals; one action a control step."""

  def __init__(
    self,
    scene: Any,
    *,
    gait: GaitSettings | None = None,
    steering: SteeringSettings | None = None,
    head_pan_limit: float | None = None,
    entrained: bool = False,
  ):
    """Creates a walker.

    Args:
      scene: The bundle, for its free space.
      gait: Parameters of the gait.
      steering: Parameters of the steering.
      head_pan_limit: As the task's robot has it.
      entrained: Whether the gait's phase follows the control signals that were applied instead of a
        clock; then `follow` is to be called after every `act`.
    """
    self._planner = Planner(scene)
    kind = EntrainedGait if entrained else Gait
    self._gait = kind(gait, head_pan_limit=head_pan_limit)
    self.steering = steering or SteeringSettings()
    self._gaze = Gaze()
    self._ball_push = Push(self._planner, self.steering.push)
    self.reset(Pose(0.0, 0.0, 0.0))

  def reset(self, start: Pose) -> None:
    """Begins an episode, standing at a place."""
    self._gait.reset()
    self._gaze.reset()
    self.pose = start  # the estimated pose
    self._command = Command(step=False)
    self._path: np.ndarray | None = None
    self._planned = -np.inf
    self._time = 0.0
    self._ball_push.reset()

  @property
  def command(self) -> Command:
    """What the gait was last commanded to do."""
    return self._command

  def follow(self, control: np.ndarray) -> None:
    """Takes the gait to a control [20] that was applied in place of its own; see `Gait.follow`."""
    self._gait.follow(control)

  def act(
    self,
    observation: Mapping[str, np.ndarray],
    *,
    goal: np.ndarray,
    pose: Pose | None = None,
    ball: np.ndarray | None = None,
  ) -> np.ndarray:
    """Returns the next action [20], normalised.

    Args:
      observation: With `gyroscope`, `gravity` and `joint_positions` as a policy has them.
      goal: Where to walk, or where to push the ball [2] [m].
      pose: Where the robot is; None: by dead reckoning.
      ball: Where the ball is [2] [m]; None: there is none.
    """
    gyroscope, gravity = observation["gyroscope"][-1], observation["gravity"][-1]
    self._locate(pose, gyroscope)
    goal = np.asarray(goal, np.float64)
    if ball is None:
      self._command = self._walk_to(goal)
    else:
      self._command = self._push(np.asarray(ball, np.float64)[:2], goal)
    if ball is not None and self.steering.watches_ball:
      before, (pan, tilt) = np.asarray(observation["joint_positions"])[-2:, _HEAD]
      view = view_of(self.pose, ball)
      self._command = self._gaze.apply(
        self._command, view, pan=float(pan), tilt=float(tilt), moved=float(pan - before[0])
      )
    elif self.steering.head_tilt is not None:
      self._command = dataclasses.replace(self._command, head=(0.0, self.steering.head_tilt))
    self._time += _TIMESTEP
    return self._gait.act(self._command, gyroscope=gyroscope, gravity=gravity)

  def _locate(self, pose: Pose | None, gyroscope: np.ndarray) -> None:
    if pose is not None:
      self.pose = pose
      return
    if self._time == 0.0:
      return
    yaw = self.pose.yaw + float(gyroscope[2]) * _TIMESTEP
    advance = self._command.forward * self.steering.speed * _TIMESTEP * self._command.step
    self.pose = Pose(
      self.pose.x + advance * np.cos(yaw), self.pose.y + advance * np.sin(yaw), float(yaw)
    )

  def _walk_to(self, goal: np.ndarray) -> Command:
    if np.linalg.norm(goal - self.pose.xy) < self.steering.arrival:
      return Command(step=False)
    if (
      self._path is None
      or self._time >= self._planned + self.steering.replan
      or (self._path[-1] != goal).any()
    ):
      self._path, self._planned = self._planner.path(self.pose.xy, goal), self._time
    return self._aim(self._lookahead(self._path, self.steering.lookahead))

  def _lookahead(self, path: np.ndarray, ahead: float) -> np.ndarray:
    """Returns the point [2] so far ahead [m] on a path [N, 2], from the path's nearest one."""
    distance = np.linalg.norm(path - self.pose.xy, axis=1)
    nearest = int(np.argmin(distance))
    further = np.flatnonzero(distance[nearest:] >= ahead)
    return path[nearest + int(further[0])] if len(further) else path[-1]

  def _aim(self, point: np.ndarray) -> Command:
    """Returns the command that turns and walks to a point [2]."""
    steering = self.steering
    offset = point - self.pose.xy
    error = np.arctan2(offset[1], offset[0]) - self.pose.yaw
    error = float((error + np.pi) % (2 * np.pi) - np.pi)
    turn = float(np.clip(steering.turn_gain * error, -1.0, 1.0))
    forward = max(0.0, 1.0 - abs(error) / steering.turn_first)
    return Command(forward=forward, turn=turn)

  def _push(self, ball: np.ndarray, target: np.ndarray) -> Command:
    """Returns the command that brings the ball to a target: around it first, then through it."""
    way = self._ball_push.way(self.pose.xy, ball, target)
    if way.pushes:
      return self._aim(way.point)
    path = self._ball_push.path(self.pose.xy, ball, way.point)
    return self._aim(self._lookahead(path, self.steering.circling))
