"""Recorded walks simulated again: a robot that stood still follows the commands of its log.

The policy is not in the simulation: what it did is in the commands. A walk is told by means over
its first seconds, as single courses drift apart at every tread:

  lag   (target - position) in the direction in which the target moves: friction, damping, lateness
  sag   target - position: loads, weak motors
  turn  turning rates about the IMU's axes, and their squares

Shapes: J joints of a log, N samples, D = 2 J + 6 figures.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.robot_logs.reading import Log
from nerf2real.suite.effects import Effect, EffectStack
from nerf2real.suite.effects.drawing import as_gravity
from nerf2real.sysid.model.drive import actuator_of
from nerf2real.sysid.sensors import standing

Array = np.ndarray

TORSO = 6
"""Figures at the end that are of the torso; those before are of joints, lags and then sags."""
_STEP = 0.0025  # s of the simulation, as the suite's
_SETTLE = 0.5  # s in which the simulated robot comes to rest before its first command
_LONGEST = 2.0  # s of a walk that are compared; chosen: beyond, courses drift apart
_SHORTEST = 1.0  # s of a walk; chosen: two steps
_EVERY = 0.01  # s between samples of the means
_MOVES = 0.2  # rad/s from which a target has a direction


class Walk(NamedTuple):
  """A walk that began at rest on both feet."""

  log: Log  # with an IMU
  begin: float  # s of the log, from which it stood still
  first: float  # its first command
  last: float  # its last command
  heading: float  # rad in the world, of the root's x axis

  @property
  def seconds(self) -> float:
    """How much of it is compared [s]."""
    return min(_LONGEST, self.last - self.first)

  @property
  def is_long(self) -> bool:
    """Whether it is long enough to be compared."""
    return self.seconds >= _SHORTEST


class Replay:
  """A model with effects that follows recorded commands.

  replay = Replay(model, effects, root)
  figures = replay.figures(walk)  # beside measured(walk)
  """

  def __init__(self, model: mujoco.MjModel, effects: Sequence[Effect], root: int):
    """Takes a model with a floor and the free body of the robot; the model stays as it is."""
    self._model = copy.copy(model)
    self._model.opt.timestep = _STEP
    self._effects = [as_gravity(effect) for effect in effects]
    self._root = root
    self._start = int(model.jnt_qposadr[model.body_jntadr[root]])
    self._gyroscope = _gyroscope(model)

  def figures(self, walk: Walk) -> Array:
    """Returns the figures [D] of a walk as the model has them."""
    model, log, commands = self._model, walk.log, walk.log.commands
    assert commands.position is not None
    data = mujoco.MjData(model)
    stack = EffectStack(self._effects).bind(model, joints=log.joints)
    try:
      places = self._stand(data, walk)
      actuators = [actuator_of(model, name) for name in commands.joints]
      control = np.zeros(model.nu)
      steps = round((_SETTLE + walk.seconds) / _STEP)
      time = _STEP * np.arange(1, steps + 1) - _SETTLE
      stamps = commands.stamp - walk.first
      at = np.searchsorted(stamps, time - _STEP + 1e-9, side="right") - 1
      stood = int(np.searchsorted(commands.stamp, walk.first - 1e-6)) - 1
      position, rate = np.empty((steps, len(places))), np.empty((steps, 3))
      for k in range(steps):
        control[actuators] = commands.position[max(at[k], stood)]
        stack.before_step(data, control)
        mujoco.mj_step(model, data)
        position[k] = stack.observe("joint_positions", data.qpos[places], data.time)
        rate[k] = data.sensordata[self._gyroscope : self._gyroscope + 3]
    finally:
      stack.unbind()
    return _figures(walk, time, position, time, rate)

  def bearing(self, walk: Walk) -> list[str]:
    """Returns the joints between the root and what touches the floor at the stand."""
    model, data = self._model, mujoco.MjData(self._model)
    self._stand(data, walk)
    data.qpos[self._start + 2] -= 0.002
    mujoco.mj_forward(model, data)
    found = set()
    for geom in np.unique(data.contact.geom[: data.ncon]):
      body = int(model.geom_bodyid[geom])
      while body not in (0, self._root) and model.body_rootid[body] == self._root:
        found |= {model.body_jntadr[body] + k for k in range(model.body_jntnum[body])}
        body = int(model.body_parentid[body])
    return [model.joint(j).name for j in sorted(found) if model.joint(j).name in walk.log.joints]

  def _stand(self, data: mujoco.MjData, walk: Walk) -> Array:
    """Stands the robot on the floor as it was measured; returns where its joints are in qpos."""
    model, log, start = self._model, walk.log, self._start
    assert log.states.position is not None and log.imu is not None
    places = model.jnt_qposadr[[model.joint(name).id for name in log.joints]]
    still = _within(log.states.stamp, walk.begin, walk.first)
    data.qpos[:] = model.qpos0
    data.qpos[start + 3 : start + 7] = (1, 0, 0, 0)
    data.qpos[places] = np.median(log.states.position[still], axis=0)
    self._place(data)
    site = int(model.sensor_objid[_sensor(model)])
    turn = data.site_xmat[site].reshape(3, 3)
    calm = _within(log.imu.stamp, walk.begin, walk.first)
    up = turn @ np.mean(log.imu.linear_acceleration[calm], axis=0)
    normal = standing.normal(model, data, self._root, up / np.linalg.norm(up))
    normal = np.array([0.0, 0, 1]) if normal is None else normal
    across = np.cross(normal, [0.0, 0, 1])
    size = max(float(np.linalg.norm(across)), 1e-12)
    lean = Rotation.from_rotvec(across / size * np.arctan2(size, normal[2]))
    turned = Rotation.from_euler("z", walk.heading) * lean
    data.qpos[start + 3 : start + 7] = turned.as_quat(scalar_first=True)
    self._place(data)
    data.qpos[start + 2] -= standing.lowest(model, data, self._root)
    mujoco.mj_forward(model, data)
    return places

  def _place(self, data: mujoco.MjData) -> None:
    mujoco.mj_kinematics(self._model, data)
    mujoco.mj_comPos(self._model, data)


def measured(walk: Walk) -> Array:
  """Returns the figures [D] of a walk as it was recorded."""
  log = walk.log
  assert log.imu is not None and log.states.position is not None
  calm = _within(log.imu.stamp, walk.begin, walk.first)
  rate = log.imu.angular_velocity - np.mean(log.imu.angular_velocity[calm], axis=0)
  time, position = log.states.stamp - walk.first, log.states.position
  return _figures(walk, time, position, log.imu.stamp - walk.first, rate)


def _figures(walk: Walk, time: Array, position: Array, imu_time: Array, rate: Array) -> Array:
  """Returns the figures [D] of courses of positions [N, J] and turning rates [N, 3]."""
  commands = walk.log.commands
  assert commands.position is not None
  at = np.arange(0.0, walk.seconds, _EVERY)
  order = [commands.joints.index(name) for name in walk.log.joints]
  target = _at(at, commands.stamp - walk.first, commands.position[:, order])
  speed = np.gradient(target, _EVERY, axis=0)
  behind = target - _at(at, time, position)
  moving = np.abs(speed) > _MOVES
  lag = np.sum(behind * np.sign(speed) * moving, axis=0) / np.maximum(moving.sum(axis=0), 1)
  turned = _at(at, imu_time, rate)
  return np.concatenate([lag, behind.mean(axis=0), turned.mean(axis=0), (turned**2).mean(axis=0)])


def _at(at: Array, time: Array, values: Array) -> Array:
  return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def _within(stamp: Array, begin: float, end: float) -> Array:
  return (stamp >= begin) & (stamp <= end)


def _sensor(model: mujoco.MjModel) -> int:
  """Returns the first gyroscope's index."""
  return int(np.flatnonzero(model.sensor_type == int(mujoco.mjtSensor.mjSENS_GYRO))[0])


def _gyroscope(model: mujoco.MjModel) -> int:
  return int(model.sensor_adr[_sensor(model)])
