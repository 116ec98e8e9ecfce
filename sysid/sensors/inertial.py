"""The IMU: what its readings say beyond the model's sensors along the measured motion.

The joints are moved as they were measured; MuJoCo's own sensors give what an ideal IMU would read.
What it does read is taken to be, as `suite.effects.kinds.measurement` has it,

    lag(scale R' truth + bias, delay)

A kind is named if the others without it explain held-out seconds worse, and if all of its interval
is beyond what IMUs of one kind differ by. Of an IMU that hardly moves, tilt, scale and bias of the
accelerometer look alike: then none of them is named.

Shapes: N readings, G samples of joint states.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core import least_squares
from nerf2real.core.geometry.rotations import matrix_from_rotvec
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.motion import smooth_motion
from nerf2real.sysid.sensors import sensed
from nerf2real.sysid.sensors.sensed import Estimate, Estimates, Part
from nerf2real.sysid.settings import SETTINGS

Array = np.ndarray

_AXES = "xyz"
_CHANNELS = ("gyroscope", "accelerometer")
_LAYOUT = {
  "imu_tilt": tuple(_AXES),
  "imu_scale/gyroscope": ("gyroscope",),
  "imu_scale/accelerometer": ("accelerometer",),
  "imu_bias/gyroscope": tuple(f"gyroscope_{a}" for a in _AXES),
  "imu_bias/accelerometer": tuple(f"accelerometer_{a}" for a in _AXES),
  "imu_lag": ("delay",),
}
"""Parts of kinds that are told apart, and the parameters that are fitted of each."""
_USUAL = {
  "imu_tilt": 0.012,
  "imu_scale/gyroscope": 0.02,
  "imu_scale/accelerometer": 0.02,
  "imu_bias/gyroscope": 0.005,
  "imu_bias/accelerometer": 0.15,
  "imu_lag": 0.008,
}
"""rad, 1, 1, rad/s, m/s^2, s; ours: what a data sheet, soldering and the zeros of encoders allow,
and a chip's low-pass (5.9 ms at 41 Hz, MPU-9250) with a bus cycle."""
_LATEST = 0.1  # s
_FEWEST = 200  # readings
_MOVE = 1e-4  # of finite differences
_MOST = 600  # readings of a log that are looked at


@dataclasses.dataclass(frozen=True)
class _Readings:
  """One log: what an ideal IMU would read and what was read."""

  time: Array  # [G] s
  truth: Array  # [G, 6]
  stamp: Array  # [N] s
  read: Array  # [N, 6]
  noise: Array  # [6]


def find(model: mujoco.MjModel, logs: Sequence[Log]) -> Part | None:
  """Returns the IMU's effects; None where model or logs have no IMU, or its motion is unknown."""
  sensors = _sensors(model)
  if sensors is None or any(log.imu is None or len(log.imu.stamp) < _FEWEST for log in logs):
    return None
  if any(not _moves_as_measured(model, log) for log in logs):
    return None
  parts = [_readings(model, log, sensors) for log in logs]
  noise = np.median([p.noise for p in parts], axis=0)
  names = tuple(_LAYOUT)
  full, fitted = _score(parts, noise, names)
  bare, _ = _score(parts, noise, ())
  without = {n: _score(parts, noise, tuple(m for m in names if m != n))[0] for n in names}
  bounds = _intervals(parts, noise, names, fitted)
  where = model.sensor(sensors[0]).name
  rows: dict[str, dict[str, Any]] = {}
  for name in names:
    values, sure = _claimed(name, names, fitted, bounds)
    gain = without[name] - full
    if sure and gain > sensed.GAIN:
      row = sensed.row(_kind(name), where, values, gain, bare - full)
      known = rows.setdefault(row["kind"], row)
      known["parameters"] |= row["parameters"]
  alternatives = []
  for name in names if not rows and bare - full > sensed.GAIN else ():
    alone, x = _score(parts, noise, (name,))
    if alone - full < sensed.GAIN:  # explains as much by itself as all together
      own = _intervals(parts, noise, (name,), x)
      values, sure = _claimed(name, (name,), x, own)
      if sure:
        row = sensed.row(_kind(name), where, values, bare - alone, bare - full)
        alternatives.append(row)
  kept = tuple(n for n in names if _kind(n) in rows)
  after = _score(parts, noise, kept)[0]
  return Part(
    list(rows.values()),
    alternatives,
    before=float(np.exp(bare)),
    after=float(np.exp(after)),
    estimates=_estimates(names, fitted, bounds),
  )


def _estimates(
  names: Sequence[str], x: Array, bounds: dict[str, dict[str, tuple[float, float]]]
) -> Estimates:
  """Returns all values of a fit with their intervals."""
  return {
    (_kind(part), name): Estimate(float(value), *bounds[part][name], _USUAL[part])
    for part, values in _unpack(names, x).items()
    for name, value in zip(_LAYOUT[part], values, strict=True)
  }


def _kind(part: str) -> str:
  """Returns the kind of effect that a part of `_LAYOUT` is of."""
  return part.split("/")[0]


def _sensors(model: mujoco.MjModel) -> tuple[int, int] | None:
  """Returns the first gyro and accelerometer."""
  kinds = list(model.sensor_type)
  wanted = (int(mujoco.mjtSensor.mjSENS_GYRO), int(mujoco.mjtSensor.mjSENS_ACCELEROMETER))
  if not all(kind in kinds for kind in wanted):
    return None
  return kinds.index(wanted[0]), kinds.index(wanted[1])


def _moves_as_measured(model: mujoco.MjModel, log: Log) -> bool:
  """Tells whether all joints of a model are hinges or slides whose positions were measured."""
  return model.nv == model.njnt and {model.joint(i).name for i in range(model.njnt)} <= set(
    log.joints
  )


def _readings(model: mujoco.MjModel, log: Log, sensors: tuple[int, int]) -> _Readings:
  motion = smooth_motion(log)
  data = mujoco.MjData(model)
  ids = [model.joint(name).id for name in log.joints]
  qpos, dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
  at = np.concatenate([model.sensor_adr[s] + np.arange(3) for s in sensors])
  site = int(model.sensor_objid[sensors[1]])
  fixed = model.body_weldid[model.site_bodyid[site]] == 0
  gravity = np.array(model.opt.gravity)
  truth = np.empty((len(motion.time), 6))
  for n in range(len(motion.time)):
    data.qpos[qpos] = motion.position[n]
    data.qvel[dofs] = motion.velocity[n]
    data.qacc[dofs] = motion.acceleration[n]
    mujoco.mj_inverse(model, data)
    truth[n] = data.sensordata[at]
    if fixed:  # of a body that cannot move MuJoCo computes no acceleration
      truth[n] = np.concatenate([np.zeros(3), -data.site_xmat[site].reshape(3, 3).T @ gravity])
  imu = log.imu
  assert imu is not None
  inner = (imu.stamp > motion.time[0] + _LATEST) & (imu.stamp < motion.time[-1] - _LATEST)
  read = np.hstack([imu.angular_velocity, imu.linear_acceleration])
  noise = _noise(read)
  few = slice(None, None, max(1, int(inner.sum()) // _MOST))
  return _Readings(motion.time, truth, imu.stamp[inner][few], read[inner][few], noise)


def _noise(read: Array) -> Array:
  """Returns the noise of the six channels, from second differences of the readings [N, 6]."""
  jumps = 1.4826 * np.median(np.abs(np.diff(read, n=2, axis=0)), axis=0) / np.sqrt(6)
  return np.maximum(jumps, (1e-4,) * 3 + (1e-3,) * 3)


def _predict(part: _Readings, kinds: Sequence[str], x: Array) -> Array:
  """Returns what an IMU with effects reads [N, 6]."""
  value = {n: v for k, v in _unpack(kinds, x).items() for n, v in zip(_LAYOUT[k], v, strict=True)}
  tilt = matrix_from_rotvec([value.get(a, 0.0) for a in _AXES])
  delay = value.get("delay", 0.0)
  seen = np.stack([np.interp(part.stamp - delay, part.time, c) for c in part.truth.T], axis=1)
  scale = np.repeat([value.get(c, 1.0) for c in _CHANNELS], 3)
  bias = np.array([value.get(f"{c}_{a}", 0.0) for c in _CHANNELS for a in _AXES])
  seen = np.hstack([seen[:, :3] @ tilt, seen[:, 3:] @ tilt])
  return seen * scale + bias


def _unpack(kinds: Sequence[str], x: Array) -> dict[str, Array]:
  values, at = {}, 0
  for kind in kinds:
    count = len(_LAYOUT[kind])
    values[kind] = x[at : at + count]
    at += count
  return values


def _nominal(kinds: Sequence[str]) -> Array:
  return np.array([1.0 if k.startswith("imu_scale") else 0.0 for k in kinds for _ in _LAYOUT[k]])


def _residuals(parts: Sequence[_Readings], noise: Array, kinds: Sequence[str], x: Array) -> Array:
  """Returns residuals in units of noise [all N, 6]."""
  return np.concatenate([(p.read - _predict(p, kinds, x)) / noise for p in parts])


def _fit(
  parts: Sequence[_Readings], noise: Array, kinds: Sequence[str], chosen: Array, start: Array
) -> Array:
  """Returns the values [n] that explain the chosen readings best: Gauss-Newton, robust."""
  x = start.copy()
  for _ in range(sensed.STEPS if len(x) else 0):
    base = _residuals(parts, noise, kinds, x)[chosen]
    jacobian = _jacobian(parts, noise, kinds, x)[:, chosen]
    weight = least_squares.cauchy_weights(base, sensed.SOFT)
    x = x - least_squares.gauss_newton_step(jacobian * weight, base * weight, rcond=1e-9)
    if "imu_lag" in kinds:
      place = sum(len(_LAYOUT[k]) for k in kinds[: kinds.index("imu_lag")])
      x[place] = np.clip(x[place], -_LATEST, _LATEST)
  return x


def _jacobian(parts: Sequence[_Readings], noise: Array, kinds: Sequence[str], x: Array) -> Array:
  """Returns the derivatives of the residuals [n, all N, 6]."""
  base = _residuals(parts, noise, kinds, x)
  rows = [_residuals(parts, noise, kinds, x + move) - base for move in _MOVE * np.eye(len(x))]
  return np.stack(rows) / _MOVE


def _late(parts: Sequence[_Readings], noise: Array) -> float:
  """Returns the delay that fits best by itself: the error has a valley a period of the motion."""
  tried = np.linspace(0.0, 0.8 * _LATEST, 17)
  errors = [
    np.mean(np.abs(_residuals(parts, noise, ("imu_lag",), np.array([late])))) for late in tried
  ]
  return float(tried[int(np.argmin(errors))])


def _blocks(parts: Sequence[_Readings]) -> Array:
  """Returns the number of the second, counted over all logs, that a reading is in [all N]."""
  labels, first = [], 0
  for p in parts:
    block = np.floor((p.stamp - p.stamp[0]) / SETTINGS.block_s).astype(int) + first
    first = int(block.max()) + 1
    labels.append(block)
  return np.concatenate(labels)


def _score(parts: Sequence[_Readings], noise: Array, kinds: Sequence[str]) -> tuple[float, Array]:
  """Returns the logarithm of the error on held-out seconds, and the values fitted to all."""
  odd = _blocks(parts) % 2 == 1
  start = _nominal(kinds)
  if "imu_lag" in kinds:
    start[sum(len(_LAYOUT[k]) for k in kinds[: kinds.index("imu_lag")])] = _late(parts, noise)
  whole = _fit(parts, noise, kinds, np.ones(len(odd), bool), start)
  squares = []
  for fitted in (odd, ~odd):
    x = _fit(parts, noise, kinds, fitted, whole)
    squares.append(np.square(_residuals(parts, noise, kinds, x)[~fitted]))
  # The mean over channels of logarithms: a gyro may be a hundred times more exact.
  mean = np.mean(np.concatenate(squares), axis=0)
  return float(np.mean(0.5 * np.log(mean))), whole


def _intervals(
  parts: Sequence[_Readings], noise: Array, kinds: Sequence[str], x: Array
) -> dict[str, dict[str, tuple[float, float]]]:
  """Returns intervals of all values, from the scatter of the residual over whole seconds."""
  base = _residuals(parts, noise, kinds, x)
  found = least_squares.block_covariance(
    _jacobian(parts, noise, kinds, x), base, _blocks(parts), rcond=1e-9
  )
  spread = sensed.SIGMAS * least_squares.standard_deviations(found)
  low, high = _unpack(kinds, x - spread), _unpack(kinds, x + spread)
  return {
    k: {n: (float(low[k][i]), float(high[k][i])) for i, n in enumerate(_LAYOUT[k])} for k in kinds
  }


def _claimed(
  kind: str, kinds: Sequence[str], x: Array, bounds: dict[str, dict[str, tuple[float, float]]]
) -> tuple[dict[str, tuple[float, float, float]], bool]:
  """Returns a kind's values with their bounds, and whether one is surely larger than usual."""
  fitted = zip(_LAYOUT[kind], map(float, _unpack(kinds, x)[kind]), strict=True)
  values = {name: (value, *bounds[kind][name]) for name, value in fitted}
  nominal = float(_nominal((kind,))[0])
  sure = any(
    low > nominal + _USUAL[kind] or high < nominal - _USUAL[kind]
    for _, low, high in values.values()
  )
  return values, sure and values.get("delay", (0.0,))[0] >= 0.0
