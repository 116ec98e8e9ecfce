"""Healthy machines with an IMU, made without MuJoCo: chains of hinges by composing rotations.

Readings are differences of poses on a fine grid, filtered as on a chip, late by a bus, rounded,
noisy; encoders have counts, zeros, a skew and stale readings. What differs from the declared model
stays within a third (one standard deviation) of what data sheets of such parts allow.

Shapes: T fine steps, J joints.
"""

import dataclasses

import numpy as np
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from nerf2real.core.robot_logs.reading import ImuSeries, JointSeries, Log

_STEP = 5e-4  # s
_COUNT = 2 * np.pi / 4096
_BANDWIDTH = (42.0, 99.0)  # Hz; MPU-9250's filters of 5.9 ms (41 Hz) and 2.9 ms (92 Hz)


@dataclasses.dataclass(frozen=True)
class Machine:
  """A chain of hinges with an IMU on the last link."""

  places: np.ndarray
  """[J + 1, 3] m, each in the link before; the last is the IMU's."""
  axes: np.ndarray
  """[J, 3]."""

  def xml(self) -> str:
    """Returns the declared model."""
    text = "".join(
      f'<body pos="{_numbers(p)}"><joint name="j{i}" axis="{_numbers(a)}" damping="1"/>'
      '<geom size=".02" pos="0 0 -.1" mass=".1"/>'
      for i, (p, a) in enumerate(zip(self.places[:-1], self.axes, strict=True))
    )
    text += f'<site name="imu" pos="{_numbers(self.places[-1])}"/>' + "</body>" * len(self.axes)
    drives = "".join(f'<position joint="j{i}" kp="20"/>' for i in range(len(self.axes)))
    return (
      f"<mujoco><worldbody>{text}</worldbody><actuator>{drives}</actuator><sensor>"
      '<gyro name="gyroscope" site="imu"/><accelerometer name="accelerometer" site="imu"/>'
      "</sensor></mujoco>"
    )


def _numbers(values) -> str:
  return " ".join(f"{v:.5f}" for v in values)


def draw(rng: np.random.Generator) -> Machine:
  """Draws a machine of one to four hinges."""
  count = int(rng.integers(1, 5))
  axes = np.eye(3)[rng.permutation(3)[np.arange(count) % 3]]
  places = rng.uniform(-0.05, 0.05, (count + 1, 3)) - [0, 0, 0.1]
  return Machine(np.round(places, 5), axes)


def _motion(rng: np.random.Generator, count: int, time: np.ndarray, kind: str) -> np.ndarray:
  """Returns the joints' true angles [T, J], from rest."""
  ramp = np.clip(time / 1.0, 0, 1)[:, None]
  ramp = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
  phase = rng.uniform(0, 2 * np.pi, count)
  if kind == "sweep":
    wave = np.sin(2 * np.pi * (0.2 * time + 0.06 * time**2)[:, None] + phase)
  elif kind == "slow":
    wave = np.arcsin(0.98 * np.sin(2 * np.pi * 0.2 * time[:, None] + phase)) / 1.5
  else:  # steps through a servo of second order
    levels = rng.uniform(-1, 1, (int(time[-1] / 1.2) + 2, count))[(time / 1.2).astype(int)]
    wave = sosfilt(butter(2, 2.5, fs=1 / _STEP, output="sos"), levels, axis=0)
  return rng.uniform(0.3, 0.7, count) * ramp * wave


def ideal(machine: Machine, angles: np.ndarray) -> np.ndarray:
  """Returns rates and specific force [T, 6] in the IMU's frame, by differences of its poses."""
  turn, place = Rotation.identity(len(angles)), np.tile(machine.places[0], (len(angles), 1))
  for j, axis in enumerate(machine.axes):
    turn = turn * Rotation.from_rotvec(angles[:, j, None] * axis)
    place = place + turn.apply(machine.places[j + 1])
  between = (turn[:-2].inv() * turn[2:]).as_rotvec() / (2 * _STEP)
  force = (place[2:] - 2 * place[1:-1] + place[:-2]) / _STEP**2 + [0, 0, 9.81]
  seen = np.hstack([between, turn[1:-1].inv().apply(force)])
  return np.vstack([seen[:1], seen, seen[-1:]])


def log(machine: Machine, kind: str, seed: int, unit: int, *, duration: float = 10.0) -> Log:
  """Returns a log of a healthy unit of a machine.

  Args:
    machine: what it is.
    kind: "sweep", "slow" or "steps".
    seed: of motion and noise.
    unit: seed of what this unit differs by from the declared one.
    duration: s.
  """
  rng, own = np.random.default_rng([seed, 11]), np.random.default_rng([unit, 12])
  count = len(machine.axes)
  time = np.arange(0.0, duration, _STEP)
  angles = _motion(rng, count, time, kind)
  names = tuple(f"j{i}" for i in range(count))
  # What units differ by, one standard deviation a third of what is usual.
  tilt = Rotation.from_rotvec(own.normal(0, 0.01 / 3, 3))
  scale = np.repeat(1 + own.normal(0, 0.02 / 3, 2), 3)
  bias = own.normal(0, 1, 6) * np.repeat([0.005 / 3, 0.15 / 3], 3)
  noise = np.repeat([own.uniform(0.001, 0.005), own.uniform(0.02, 0.08)], 3)
  bandwidth = own.uniform(*_BANDWIDTH)
  bus, skew = own.uniform(0.0, 0.0015, 2)
  zeros = own.normal(0, 0.003, count)

  seen = ideal(machine, angles)
  seen = np.hstack([tilt.inv().apply(seen[:, :3]), tilt.inv().apply(seen[:, 3:])])
  filtered = butter(1, bandwidth, fs=1 / _STEP, output="sos")
  start = seen[0]
  seen = sosfilt(filtered, seen - start, axis=0) + start
  stamps = np.arange(0.02, duration - 0.02, 0.008)
  stamps = stamps + rng.normal(0, 0.0003, len(stamps))
  late = stamps - bus - np.abs(rng.normal(0, 0.0005, len(stamps)))
  read = np.stack([np.interp(late, time, c) for c in seen.T], axis=1) * scale + bias
  read += rng.normal(0, 1, read.shape) * noise
  lsb = np.repeat([np.deg2rad(2000) / 32768, 4 * 9.81 / 32768], 3)
  read = np.round(read / lsb) * lsb

  at = np.arange(0.005, duration - 0.01, 0.01)
  at = at + rng.normal(0, 0.0003, len(at))
  true = np.stack([np.interp(at - skew, time, c) for c in angles.T], axis=1) + zeros
  position = np.round((true + rng.normal(0, 0.2 * _COUNT, true.shape)) / _COUNT) * _COUNT
  for row in np.flatnonzero(rng.random(len(at)) < 0.01):  # stale readings
    position[row] = position[max(int(row) - 1, 0)]
  return Log(
    name=f"{kind}.mcap",
    start_ns=0,
    commands=JointSeries(names, at, at, position, None, None),
    states=JointSeries(names, at, at, position, None, None),
    pwm=None,
    imu=ImuSeries(stamps, stamps, read[:, :3], read[:, 3:], "imu"),
    battery=None,
    temperatures={},
  )
