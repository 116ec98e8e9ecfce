"""The floor's slope: what a standing robot's legs say of the floor, its accelerometer of gravity.

While the robot stands still, the joints give the floor's normal in the torso's frame (`standing`),
the accelerometer the direction of gravity. In a frame that turns with the robot's heading psi they
differ horizontally by

    m = Rz(-psi) s + b

s: the floor's slope, fixed in the world. b: what turns with the robot, a tilted or biased IMU,
zeros of the legs' encoders. Headings are known, or come from the integrated gyroscope, its zero
from the stops. A robot that always faces one way cannot tell s from b: then both are listed as
alternatives.

The slope's axes are those of the known headings, else the world's of a model that faces at its
first stop as in qpos0.

Shapes: N readings, K stops.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from nerf2real.core import least_squares
from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model import chains
from nerf2real.sysid.sensors import sensed, standing
from nerf2real.sysid.sensors.sensed import Estimate, Part, row
from nerf2real.sysid.sensors.stops import Stood, Stops, find_stops, join_stops, known_stops

Array = np.ndarray

_USUAL = 0.02  # rad; ours: floors of rooms, zeros of encoders
_NOISE = 0.002  # rad; no stop is known better
_ROUGH = (
  0.01  # rad that stops may differ by from the rule: else it was held, or stepped on something
)
_FEWEST = 3  # headings
_GRAVITY = 9.81  # m/s^2


def find(
  model: mujoco.MjModel, logs: Sequence[Log], known: Sequence[Sequence[Stood]] | None = None
) -> Part | None:
  """Returns the floor's slope; None where model or logs cannot show one.

  Args:
    model: with a floor, and a free body with an accelerometer.
    logs: of it; each is judged by its own stops.
    known: where it stood in each log and how it faced: all are judged together then. None: stops
      and headings are found.
  """
  plane, root, site = standing.floor(model), _root(model), _site(model)
  if plane is None or root is None or site is None:
    return None
  if model.body_rootid[model.site_bodyid[site]] != root or any(log.imu is None for log in logs):
    return None
  limbs = [model.joint(i).name for i in range(model.njnt) if _of(model, i) == root]
  if any(not set(limbs) <= set(log.joints) for log in logs):
    return None
  if known is None:
    found = [find_stops(model, log, root, site) for log in logs]
  else:
    each = [known_stops(model, *one, root, site) for one in zip(logs, known, strict=True)]
    found = [join_stops(each)]
  found = [s for s in found if len(s.heading)]
  if not found:
    return Part(notes=["The robot never stands still in the logs: no slope of the floor shows."])
  judged = [_judge(s, plane) for s in found]
  named = [part for part in judged if part.rows]
  return max(named or judged, key=lambda part: part.before or 0.0)


def _root(model: mujoco.MjModel) -> int | None:
  """Returns the free body that actuators move; None without one, or with two."""
  free = set(model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)])
  found = chains.driven(model) & free
  return found.pop() if len(found) == 1 else None


def _of(model: mujoco.MjModel, joint: int) -> int | None:
  """Returns the root body of a hinge or slide; None of another joint."""
  single = int(model.jnt_type[joint]) in chains.SINGLE
  return int(model.body_rootid[model.jnt_bodyid[joint]]) if single else None


def _site(model: mujoco.MjModel) -> int | None:
  """Returns the site of the first accelerometer."""
  kind = int(mujoco.mjtSensor.mjSENS_ACCELEROMETER)
  found = np.flatnonzero(model.sensor_type == kind)
  return int(model.sensor_objid[found[0]]) if len(found) else None


def _fit(stops: Stops, slope: bool, chosen: Array) -> tuple[Array, Array]:
  """Returns s and b [4] and their covariance per square rad; s is 0 without slope."""
  design = _design(stops)[chosen].reshape(-1, 4)
  free = [0, 1, 2, 3] if slope else [2, 3]
  inverse = least_squares.covariance(design[:, free].T, rcond=1e-6)
  x, covariance = np.zeros(4), np.zeros((4, 4))
  x[free] = inverse @ design[:, free].T @ stops.tilt[chosen].ravel()
  covariance[np.ix_(free, free)] = inverse
  return x, covariance


def _design(stops: Stops) -> Array:
  """Returns derivatives [K, 2, 4] of the tilts by s and b."""
  cos, sin = np.cos(stops.heading), np.sin(stops.heading)
  zero, one = np.zeros_like(cos), np.ones_like(cos)
  rows = [np.stack([cos, sin, one, zero], axis=1), np.stack([-sin, cos, zero, one], axis=1)]
  return np.stack(rows, axis=1)


def _left_out(stops: Stops, slope: bool) -> float:
  """Returns the logarithm of the error [rad] on stops that were left out."""
  every, squares = np.arange(len(stops.heading)), []
  for k in every:
    x, _ = _fit(stops, slope, every != k)
    squares.append(np.mean((stops.tilt[k] - _design(stops)[k] @ x) ** 2))
  return 0.5 * float(np.log(np.mean(squares) + _NOISE**2))


def _judge(stops: Stops, plane: str) -> Part:
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
    half = sensed.SIGMAS * noise * least_squares.standard_deviations(covariance)[:2]
    gain = _left_out(stops, False) - _left_out(stops, True)
    well = np.linalg.norm(x[:2]) - half.max() > _USUAL and half.max() < np.linalg.norm(x[:2])
    told = np.linalg.matrix_rank(_design(stops).reshape(-1, 4), tol=0.3) == 4
    if told:
      part.estimates = {
        ("floor_slope", axis): Estimate(*values, _USUAL)
        for axis, values in _about_axes(x[:2], half).items()
      }
    if well and told and gain > sensed.GAIN and np.sqrt(np.mean(left**2)) < _ROUGH:
      part.rows.append(_row(plane, x[:2], half, gain))
      part.after = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
      mean, size = x[2:], float(np.linalg.norm(x[2:]))
    elif told:
      return part
  if size > _USUAL and not part.rows:
    spread = stops.tilt.std(axis=0) if count > 1 else np.zeros(2)
    half = sensed.SIGMAS * np.hypot(_NOISE, spread)
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
    ("imu_tilt", "", tilt, sensed.SIGMAS * _NOISE),
    ("imu_bias", "accelerometer_", bias, sensed.SIGMAS * _NOISE * _GRAVITY),
  ):
    values = {
      f"{prefix}{axis}": (float(v), float(v - half), float(v + half))
      for axis, v in zip("xyz", vector, strict=True)
    }
    rows.append(row(kind, "accelerometer", values, 0.0, 0.0))
  return rows
