"""The floor's slope: what a standing robot's legs say of the floor, its accelerometer of gravity.

While the robot stands still, the joints give the floor's normal in the torso's frame (`standing`),
the accelerometer the direction of gravity. In a frame that turns with the robot's heading psi they
differ horizontally by

    m = Rz(-psi) s + b

s: the floor's slope, fixed in the world. b: what turns with the robot, a tilted or biased IMU,
zeros of the legs' encoders. Headings come from the integrated gyroscope, its zero from the stops.
A robot that always faces one way cannot tell s from b: then both are listed as alternatives.

The slope's axes are the world's of a model that faces at its first stop as in qpos0.

Shapes: N readings, K stops.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from nerf2real.core import least_squares, rotations
from nerf2real.core.robot_logs.reading import ImuSeries, Log
from nerf2real.sysid.model.reduction import smooth_motion
from nerf2real.sysid.sensors import standing
from nerf2real.sysid.sensors.sensed import Estimate, Part, row

Array = np.ndarray

_STILL = (0.1, 0.05)  # rad/s of the torso beyond its zero, of any joint
_SLOWLY = 0.12  # s over which a speed is taken: counts of an encoder that flicker are no motion
_STOP = 0.6  # s that a stop lasts at least
_EDGE = 0.15  # s at both ends of a stop that are left out: the robot still rocks
_USUAL = 0.02  # rad; ours: floors of rooms, zeros of encoders
_NOISE = 0.002  # rad; no stop is known better
_ROUGH = (
  0.01  # rad that stops may differ by from the rule: else it was held, or stepped on something
)
_FEWEST = 3  # headings
_GAIN = 0.05  # nats
_GRAVITY = 9.81  # m/s^2
_SIGMAS = 3.0
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclasses.dataclass(frozen=True)
class _Stops:
  """One log's stops."""

  heading: Array
  """[K] rad in the model's world, the first as in qpos0."""
  tilt: Array
  """[K, 2] rad: the floor's normal beside gravity's, along the heading and to its left."""
  sensor: Array
  """[3, 3], torso from IMU."""


def find(model: mujoco.MjModel, logs: Sequence[Log]) -> Part | None:
  """Returns the floor's slope; None where model or logs cannot show one."""
  plane, root, site = standing.floor(model), _root(model), _site(model)
  if plane is None or root is None or site is None:
    return None
  if model.body_rootid[model.site_bodyid[site]] != root or any(log.imu is None for log in logs):
    return None
  limbs = [model.joint(i).name for i in range(model.njnt) if _of(model, i) == root]
  if any(not set(limbs) <= set(log.joints) for log in logs):
    return None
  stops = [_stops(model, log, root, site) for log in logs]
  stops = [s for s in stops if len(s.heading)]
  if not stops:
    return Part(notes=["The robot never stands still in the logs: no slope of the floor shows."])
  judged = [_judge(s, plane) for s in stops]
  named = [part for part in judged if part.rows]
  return max(named or judged, key=lambda part: part.before or 0.0)


def _root(model: mujoco.MjModel) -> int | None:
  """Returns the free body that actuators move; None without one, or with two."""
  found = set()
  for u in range(model.nu):
    if model.actuator_trntype[u] == int(mujoco.mjtTrn.mjTRN_JOINT):
      body = int(model.jnt_bodyid[model.actuator_trnid[u, 0]])
      found.add(int(model.body_rootid[body]))
  free = [b for b in found if model.body_jntnum[b] and _is_free(model, int(model.body_jntadr[b]))]
  return free[0] if len(free) == 1 else None


def _is_free(model: mujoco.MjModel, joint: int) -> bool:
  return int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)


def _of(model: mujoco.MjModel, joint: int) -> int | None:
  """Returns the root body of a hinge or slide; None of another joint."""
  single = int(model.jnt_type[joint]) in _SINGLE
  return int(model.body_rootid[model.jnt_bodyid[joint]]) if single else None


def _site(model: mujoco.MjModel) -> int | None:
  """Returns the site of the first accelerometer."""
  kind = int(mujoco.mjtSensor.mjSENS_ACCELEROMETER)
  found = np.flatnonzero(model.sensor_type == kind)
  return int(model.sensor_objid[found[0]]) if len(found) else None


def _stops(model: mujoco.MjModel, log: Log, root: int, site: int) -> _Stops:
  motion = smooth_motion(log, half_width=_SLOWLY)
  data, imu = mujoco.MjData(model), log.imu
  assert imu is not None
  moving = np.abs(motion.velocity).max(axis=1)
  rate = imu.angular_velocity
  zero = np.median(rate, axis=0)
  calm = np.interp(imu.stamp, motion.time, moving) < _STILL[1]
  calm &= _smooth(np.linalg.norm(rate - zero, axis=1)) < _STILL[0]
  spans = _spans(calm, imu.stamp)
  if not spans:
    return _Stops(np.zeros(0), np.zeros((0, 2)), np.eye(3))
  zero = np.median(np.concatenate([rate[s] for s in spans]), axis=0)
  start, address = int(model.jnt_qposadr[model.body_jntadr[root]]), model.jnt_qposadr
  qpos = address[[model.joint(name).id for name in log.joints]]
  headings, tilts, first, sensor = [], [], None, np.eye(3)
  for span in spans:
    within = (motion.time >= imu.stamp[span][0]) & (motion.time <= imu.stamp[span][-1])
    data.qpos[:] = model.qpos0
    data.qpos[start + 3 : start + 7] = (1, 0, 0, 0)
    data.qpos[qpos] = np.median(motion.position[within], axis=0)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    # The root's frame is the world's here, so is the IMU's pose in it.
    sensor = data.site_xmat[site].reshape(3, 3)
    up = sensor @ np.mean(imu.linear_acceleration[span], axis=0)
    up /= np.linalg.norm(up)
    floor = standing.normal(model, data, root, up)
    if floor is None:
      continue
    turned = _turned(imu, zero, sensor, span)
    if first is None:
      first = (up, turned)
    ahead, left = _level(up)
    tilts.append((floor @ ahead, floor @ left))
    ahead, left = _level(first[0])
    now = (first[1].inv() * turned).apply(_level(up)[0])
    headings.append(np.arctan2(now @ left, now @ ahead))
  faced = rotations.yaw_of(rotations.matrix_from_quaternion(model.qpos0[start + 3 : start + 7]))
  return _Stops(np.array(headings) + faced, np.array(tilts).reshape(-1, 2), sensor)


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


def _fit(stops: _Stops, slope: bool, chosen: Array) -> tuple[Array, Array]:
  """Returns s and b [4] and their covariance per square rad; s is 0 without slope."""
  design = _design(stops)[chosen].reshape(-1, 4)
  free = [0, 1, 2, 3] if slope else [2, 3]
  inverse = least_squares.covariance(design[:, free].T, rcond=1e-6)
  x, covariance = np.zeros(4), np.zeros((4, 4))
  x[free] = inverse @ design[:, free].T @ stops.tilt[chosen].ravel()
  covariance[np.ix_(free, free)] = inverse
  return x, covariance


def _design(stops: _Stops) -> Array:
  """Returns derivatives [K, 2, 4] of the tilts by s and b."""
  cos, sin = np.cos(stops.heading), np.sin(stops.heading)
  zero, one = np.zeros_like(cos), np.ones_like(cos)
  rows = [np.stack([cos, sin, one, zero], axis=1), np.stack([-sin, cos, zero, one], axis=1)]
  return np.stack(rows, axis=1)


def _left_out(stops: _Stops, slope: bool) -> float:
  """Returns the logarithm of the error [rad] on stops that were left out."""
  every, squares = np.arange(len(stops.heading)), []
  for k in every:
    x, _ = _fit(stops, slope, every != k)
    squares.append(np.mean((stops.tilt[k] - _design(stops)[k] @ x) ** 2))
  return 0.5 * float(np.log(np.mean(squares) + _NOISE**2))


def _judge(stops: _Stops, plane: str) -> Part:
  """Returns what one log's stops say."""
  count = len(stops.heading)
  mean = stops.tilt.mean(axis=0)
  size = float(np.linalg.norm(mean))
  part = Part(before=float(np.sqrt(np.mean(np.sum(stops.tilt**2, axis=1)))))
  part.after = part.before
  every = np.ones(count, bool)
  if count >= _FEWEST:
    x, covariance = _fit(stops, True, every)
    left = stops.tilt - _design(stops) @ x
    noise = np.sqrt(_NOISE**2 + np.sum(left**2) / max(2 * count - 4, 1))
    half = _SIGMAS * noise * least_squares.standard_deviations(covariance)[:2]
    gain = _left_out(stops, False) - _left_out(stops, True)
    well = np.linalg.norm(x[:2]) - half.max() > _USUAL and half.max() < np.linalg.norm(x[:2])
    told = np.linalg.matrix_rank(_design(stops).reshape(-1, 4), tol=0.3) == 4
    if told:
      part.estimates = {
        ("floor_slope", axis): Estimate(*values, _USUAL)
        for axis, values in _about_axes(x[:2], half).items()
      }
    if well and told and gain > _GAIN and np.sqrt(np.mean(left**2)) < _ROUGH:
      part.rows.append(_row(plane, x[:2], half, gain))
      part.after = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
      mean, size = x[2:], float(np.linalg.norm(x[2:]))
    elif told:
      return part
  if size > _USUAL and not part.rows:
    spread = stops.tilt.std(axis=0) if count > 1 else np.zeros(2)
    half = _SIGMAS * np.hypot(_NOISE, spread)
    part.alternatives.append(_row(plane, mean, half, 0.0))
  if size > _USUAL:
    part.alternatives += _of_imu(stops.sensor, mean)
  return part


def _row(plane: str, normal: Array, half: Array, gain: float) -> dict[str, Any]:
  """Returns the entry of a floor whose normal leans along x and y by [2] rad."""
  values = _about_axes(normal, half)
  found = row("floor_slope", "accelerometer", values, gain, gain)
  return {**found, "geom": plane or None}


def _about_axes(normal: Array, half: Array) -> dict[str, tuple[float, float, float]]:
  """Returns turns about x and y that lean an upright normal along x and y."""
  turn, spread = (-normal[1], normal[0]), (half[1], half[0])
  return {
    axis: (float(t), float(t - h), float(t + h))
    for axis, t, h in zip("xy", turn, spread, strict=True)
  }


def _of_imu(sensor: Array, normal: Array) -> list[dict[str, Any]]:
  """Returns the entries of a tilt and a bias of the IMU that look like a lean along x and y."""
  tilt = sensor.T @ [-normal[1], normal[0], 0.0]
  bias = sensor.T @ [-_GRAVITY * normal[0], -_GRAVITY * normal[1], 0.0]
  rows = []
  for kind, prefix, vector, half in (
    ("imu_tilt", "", tilt, _SIGMAS * _NOISE),
    ("imu_bias", "accelerometer_", bias, _SIGMAS * _NOISE * _GRAVITY),
  ):
    values = {
      f"{prefix}{axis}": (float(v), float(v - half), float(v + half))
      for axis, v in zip("xyz", vector, strict=True)
    }
    rows.append(row(kind, "accelerometer", values, 0.0, 0.0))
  return rows
