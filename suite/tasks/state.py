"""The robot's true state: where it is, how it moves, and how it stands at the start."""

import functools
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control import composer, mjcf

from nerf2real.core.geometry import rotations
from nerf2real.suite.op3 import constants, op3
from nerf2real.suite.pose import Pose
from nerf2real.suite.tasks import rewards
from nerf2real.suite.tasks.settings import PHYSICS_TIMESTEP


class RobotState(NamedTuple):
  """The robot's true state at the end of a control step."""

  position: np.ndarray  # torso [3] in the world [m]
  rotation: np.ndarray  # world from torso [3, 3]
  aligned: np.ndarray  # world from gravity-aligned frame [3, 3] (suite.tasks.rewards)
  velocity: np.ndarray  # torso [3] in the world [m/s]
  angular_velocity: np.ndarray  # torso [3] in the world [rad/s]
  feet_velocity: np.ndarray  # midpoint of the feet [3], gravity-aligned frame [m/s]
  yaw_speed: float  # of the gravity-aligned frame [rad/s]
  joints: np.ndarray  # [20] rad
  joint_velocities: np.ndarray  # [20] rad/s

  @property
  def yaw(self) -> float:
    """Heading in the world [rad]."""
    return rotations.yaw_of(self.aligned)

  @property
  def pose(self) -> Pose:
    """Place and heading on the floor."""
    return Pose.of(self.position, self.yaw)

  def relative(self, xy: np.ndarray) -> np.ndarray:
    """Returns a point of the floor [2] relative to the robot, gravity-aligned frame [2] [m]."""
    offset = np.array([xy[0], xy[1], 0.0]) - self.position
    offset[2] = 0.0
    return (offset @ self.aligned)[:2]


class RobotIndices:
  """Where the robot's numbers are in a compiled model: reads its state, places it."""

  def __init__(self, physics: Any, robot: op3.OP3):
    """Looks the robot up.

    Args:
      physics: The compiled model, dm_control's `mjcf.Physics`.
      robot: The robot in it.
    """
    self._model, self._data = physics.model.ptr, physics.data.ptr
    model = self._model
    joints = physics.bind(robot.joints).element_id
    self.joint_qpos = np.asarray(model.jnt_qposadr[joints])
    self._joint_dofs = np.asarray(model.jnt_dofadr[joints])
    self.torso = int(physics.bind(robot.torso).element_id)
    self.root = int(model.body_rootid[self.torso])
    free = model.body_jntadr[self.root]
    self.root_qpos, self._root_dof = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
    self.feet = [int(physics.bind(foot).element_id) for foot in robot.feet]
    gyroscope = physics.bind(robot.mjcf_model.find("sensor", "gyroscope")).element_id
    first = int(model.sensor_adr[gyroscope])
    self.imu = slice(first, first + 6)  # the accelerometer follows the gyroscope

  def read(self) -> RobotState:
    """Reads the state now; positions and velocities must be up to date."""
    model, data = self._model, self._data
    rotation = data.xmat[self.torso].reshape(3, 3).copy()
    aligned = rewards.gravity_aligned_frame(rotation, model.opt.gravity)
    dof = self._root_dof
    angular = rotation @ data.qvel[dof + 3 : dof + 6]
    twist, feet = np.empty(6), np.zeros(3)
    for foot in self.feet:
      mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, foot, twist, 0)
      feet += twist[3:] / 2
    return RobotState(
      position=data.xpos[self.torso].copy(),
      rotation=rotation,
      aligned=aligned,
      velocity=data.qvel[dof : dof + 3].copy(),
      angular_velocity=angular,
      feet_velocity=feet @ aligned,
      yaw_speed=rewards.yaw_rate(rotation, angular, model.opt.gravity),
      joints=data.qpos[self.joint_qpos],
      joint_velocities=data.qvel[self._joint_dofs],
    )

  def write(
    self, qpos: np.ndarray, *, position: np.ndarray, rotation: np.ndarray, joints: np.ndarray
  ) -> None:
    """Writes the robot's state, as `read` gives it, into a vector qpos."""
    root = self.root_qpos
    qpos[root : root + 3] = position
    qpos[root + 3 : root + 7] = rotations.quaternion_from_matrix(rotation)
    qpos[self.joint_qpos] = joints

  def stand_at(self, start: Pose) -> None:
    """Writes the standing posture at a place into qpos."""
    posture = standing_posture()
    qpos, root = self._data.qpos, self.root_qpos
    qpos[root : root + 2] = start.xy
    qpos[root + 2] = posture[2]
    mujoco.mju_mulQuat(qpos[root + 3 : root + 7], rotations.yaw_quaternion(start.yaw), posture[3:7])
    qpos[self.joint_qpos] = posture[7:]


@functools.cache
def standing_posture() -> np.ndarray:
  """Returns qpos [27] of the robot standing at rest at the origin on a flat floor, facing +x.

  The servos are soft: under its weight the robot settles a little away from their targets.
  """
  arena = composer.Arena()
  robot = op3.OP3()
  arena.mjcf_model.worldbody.add("geom", type="plane", size=(2, 2, 0.1))
  arena.add_free_entity(robot)
  arena.mjcf_model.option.timestep = PHYSICS_TIMESTEP
  physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
  targets = constants.standing_targets()
  joints = physics.bind(robot.joints)
  with physics.reset_context():
    physics.data.qpos[2] = 0.26
    joints.qpos = targets
    physics.set_control(targets)
  physics.step(round(2.0 / PHYSICS_TIMESTEP))
  qpos = np.concatenate([physics.data.qpos[:7], joints.qpos])
  qpos[:2] = 0.0
  qpos.setflags(write=False)
  return qpos
