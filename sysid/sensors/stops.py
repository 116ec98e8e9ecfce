"""Where a robot stands still, and how the floor's normal is beside gravity there.

The joints give the floor's normal in the torso's frame (`standing`), the accelerometer the
direction of gravity. Headings are known, or come from the integrated gyroscope, its zero from the
stops.

Shapes: N readings, K stops.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core.geometry import rotations
from nerf2real.core.robot_logs.reading import ImuSeries, Log
from nerf2real.sysid.model.motion import smooth_motion
from nerf2real.sysid.sensors import standing

Array = np.ndarray

_STILL = (0.1, 0.05)  # rad/s of the torso beyond its zero, of any joint
_SLOWLY = 0.12  # s over which a speed is taken: counts of an encoder that flicker are no motion
_STOP = 0.6  # s that a stop lasts at least
_EDGE = 0.15  # s at both ends of a stop that are left out: the robot still rocks


class Stood(NamedTuple):
  """A time in which a robot is known to have stood still on its feet."""

  begin: float  # s of the log
  end: float
  heading: float  # rad in the world, of the root's x axis


@dataclasses.dataclass(frozen=True)
class Stops:
  """The stops of a log, or of several with known headings."""

  heading: Array
  """[K] rad in the model's world, the first as in qpos0."""
  tilt: Array
  """[K, 2] rad: the floor's normal beside gravity's, along the heading and to its left."""
  sensor: Array
  """[3, 3], torso from IMU."""


def find_stops(model: mujoco.MjModel, log: Log, root: int, site: int) -> Stops:
  """Returns the stops of a log; see `known_stops`."""
  motion, imu = smooth_motion(log, half_width=_SLOWLY), log.imu
  assert imu is not None
  stance = _Stance(model, log, root, site, motion.position)
  moving = np.abs(motion.velocity).max(axis=1)
  rate = imu.angular_velocity
  zero = np.median(rate, axis=0)
  calm = np.interp(imu.stamp, motion.time, moving) < _STILL[1]
  calm &= _smooth(np.linalg.norm(rate - zero, axis=1)) < _STILL[0]
  spans = _spans(calm, imu.stamp)
  if spans:
    zero = np.median(np.concatenate([rate[s] for s in spans]), axis=0)
  headings, tilts, first = [], [], None
  for span in spans:
    found = stance.tilt(span)
    if found is None:
      continue
    up, tilt = found
    turned = _turned(imu, zero, stance.sensor, span)
    if first is None:
      first = (up, turned)
    tilts.append(tilt)
    ahead, left = _level(first[0])
    now = (first[1].inv() * turned).apply(_level(up)[0])
    headings.append(np.arctan2(now @ left, now @ ahead))
  start = int(model.jnt_qposadr[model.body_jntadr[root]])
  faced = rotations.yaw_of(rotations.matrix_from_quaternion(model.qpos0[start + 3 : start + 7]))
  return Stops(np.array(headings) + faced, np.array(tilts).reshape(-1, 2), stance.sensor)


def known_stops(
  model: mujoco.MjModel, log: Log, stood: Sequence[Stood], root: int, site: int
) -> Stops:
  """Returns the stops of a log at known times and headings.

  Args:
    model: compiled.
    log: of it, with an IMU.
    stood: where it stood.
    root: its free body.
    site: of its IMU.
  """
  assert log.imu is not None and log.states.position is not None
  stance, headings, tilts = _Stance(model, log, root, site, log.states.position), [], []
  for stop in stood:
    inner = np.searchsorted(log.imu.stamp, (stop.begin + _EDGE, stop.end - _EDGE))
    found = stance.tilt(slice(*inner)) if inner[1] > inner[0] else None
    if found is not None:
      headings.append(stop.heading)
      tilts.append(found[1])
  return Stops(np.array(headings), np.array(tilts).reshape(-1, 2), stance.sensor)


def join_stops(each: Sequence[Stops]) -> Stops:
  """Returns the stops of several logs with known headings as one."""
  heading = np.concatenate([stops.heading for stops in each])
  return Stops(heading, np.concatenate([stops.tilt for stops in each]), each[0].sensor)


class _Stance:
  """The floor's normal and gravity in the torso's frame, while a robot stands still."""

  def __init__(self, model: mujoco.MjModel, log: Log, root: int, site: int, position: Array):
    self._model, self._log, self._root, self._site = model, log, root, site
    self._data = mujoco.MjData(model)
    self._position = position  # [N, J] of the log's states
    self._start = int(model.jnt_qposadr[model.body_jntadr[root]])
    self._joints = model.jnt_qposadr[[model.joint(name).id for name in log.joints]]
    self.sensor = np.eye(3)  # torso from IMU

  def tilt(self, span: slice) -> tuple[Array, Array] | None:
    """Returns gravity's opposite [3] and the tilt [2] in a span of IMU readings."""
    imu, time, data = self._log.imu, self._log.states.stamp, self._data
    assert imu is not None
    within = (time >= imu.stamp[span][0]) & (time <= imu.stamp[span][-1])
    data.qpos[:] = self._model.qpos0
    data.qpos[self._start + 3 : self._start + 7] = (1, 0, 0, 0)
    data.qpos[self._joints] = np.median(self._position[within], axis=0)
    mujoco.mj_kinematics(self._model, data)
    mujoco.mj_comPos(self._model, data)
    # The root's frame is the world's here, so is the IMU's pose in it.
    self.sensor = data.site_xmat[self._site].reshape(3, 3).copy()
    up = self.sensor @ np.mean(imu.linear_acceleration[span], axis=0)
    up /= np.linalg.norm(up)
    floor = standing.normal(self._model, data, self._root, up)
    if floor is None:
      return None
    ahead, left = _level(up)
    return up, np.array([floor @ ahead, floor @ left])


def _smooth(values: Array) -> Array:
  """Returns a mean over 9 readings: noise is no motion."""
  return np.convolve(np.pad(values, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")


def _spans(calm: Array, stamp: Array) -> list[slice]:
  """Returns the stretches of readings in which the robot stands still, without their ends."""
  edges = np.flatnonzero(np.diff(np.concatenate([[0], calm.astype(int), [0]])))
  found = []
  for begin, end in zip(edges[::2], edges[1::2], strict=True):
    inner = np.flatnonzero(
      (stamp[begin:end] > stamp[begin] + _EDGE) & (stamp[begin:end] < stamp[end - 1] - _EDGE)
    )
    if len(inner) > 5 and stamp[end - 1] - stamp[begin] > _STOP:
      found.append(slice(begin + int(inner[0]), begin + int(inner[-1]) + 1))
  return found


def _turned(imu: ImuSeries, zero: Array, sensor: Array, span: slice) -> Rotation:
  """Returns the torso's rotation from the log's start to the middle of a stop, by the gyroscope."""
  middle = (span.start + span.stop) // 2
  steps = np.diff(imu.stamp[: middle + 1])[:, None]
  rates = (imu.angular_velocity[:middle] + imu.angular_velocity[1 : middle + 1]) / 2 - zero
  total = Rotation.identity()
  for step in Rotation.from_rotvec((rates * steps) @ sensor.T):
    total = total * step
  return total


def _level(up: Array) -> tuple[Array, Array]:
  """Returns the body's x axis made level, and what lies to its left."""
  ahead = np.array([1.0, 0, 0]) - up[0] * up
  ahead /= np.linalg.norm(ahead)
  return ahead, np.cross(up, ahead)
