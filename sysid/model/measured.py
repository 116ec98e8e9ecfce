"""What a log says of one joint: its readings, its commands, and which readings are new.

Shapes: N samples of a log, B blocks.
"""

import dataclasses

import mujoco
import numpy as np

from nerf2real.core.robot_logs.reading import Log
from nerf2real.sysid.model.drive import command_of
from nerf2real.sysid.model.motion import Motion

Array = np.ndarray

_SAME = 1e-6
"""Share of a range below which two readings differ by rounding of floating point alone."""


@dataclasses.dataclass(frozen=True)
class Measured:
  """What one log says about one joint."""

  name: str
  time: Array
  """[N] s, stamps of the states."""
  position: Array
  """[N]."""
  velocity: Array
  """[N], smoothed from positions."""
  acceleration: Array
  """[N], smoothed from positions."""
  effort: Array | None
  """[N] N m; None where it never changes: drivers fill in what they do not measure."""
  command_time: Array
  command: Array
  valid: Array
  """[N] bool: False for repeated (stale) readings."""
  temperature: Array | None
  """[N] degrees Celsius."""
  duty: Array | None
  """[N], -1 to 1."""


def measured(log: Log, motion: Motion, joint: str, model: mujoco.MjModel) -> Measured:
  """Returns one joint's part of a log; its commands are those that the model's actuator takes."""
  states, commands = log.states, log.commands
  column = states.column(joint)
  assert states.position is not None
  position = states.position[:, column]
  if joint in commands.joints:
    command_time, command = commands.stamp, command_of(log, model, joint)
    assert command is not None
  else:
    command_time, command = np.zeros(1), np.zeros(1)
  effort = None if states.effort is None else states.effort[:, column]
  series = log.temperatures.get(joint)
  duty = None
  if log.pwm is not None and log.pwm.effort is not None and joint in log.pwm.joints:
    given = log.pwm.effort[:, log.pwm.column(joint)]
    if not np.isnan(given).all():  # it has none
      duty = np.interp(states.stamp, log.pwm.stamp, given)
  return Measured(
    name=log.name,
    time=states.stamp,
    position=position,
    velocity=motion.velocity[:, column],
    acceleration=motion.acceleration[:, column],
    effort=effort if effort is not None and np.ptp(effort) > 0.0 else None,
    command_time=np.ascontiguousarray(command_time),
    command=np.ascontiguousarray(command),
    valid=fresh(states.stamp, position, motion.velocity[:, column]),
    temperature=None if series is None else np.interp(states.stamp, series.stamp, series.value),
    duty=duty,
  )


def fresh(time: Array, position: Array, velocity: Array) -> Array:
  """Returns which readings [N] are not repeats of an earlier one while the joint was moving.

  A reading is a repeat when it equals the one before although the joint moved by more than
  three times the sensor's resolution. Where all readings are the same none is a repeat.
  """
  resolution = quantum(position)
  if resolution == 0.0:
    return np.ones(len(position), bool)
  repeated = np.zeros(len(position), bool)
  moved = np.abs(velocity[1:]) * np.diff(time)
  repeated[1:] = (np.diff(position) == 0) & (moved > 3.0 * resolution)
  return ~repeated


def block_starts(time: Array, length: float) -> Array:
  """Returns where blocks of a log begin [B], a last one of less than half a block left out.

  Args:
    time: stamps [N], s.
    length: of a block, s.
  """
  first = np.unique(np.floor((time - time[0]) / length).astype(int), return_index=True)[1]
  if len(first) > 1 and len(time) - first[-1] < 0.5 * np.median(np.diff(first)):
    first = first[:-1]
  return first


def quantum(values: Array) -> float:
  """Returns the smallest step between different readings: the resolution of a sensor."""
  steps = np.diff(np.unique(values))
  steps = steps[steps > _SAME * max(float(np.ptp(values)), 1e-12)]
  return float(steps.min()) if len(steps) else 0.0


def same_commands(one: Measured, other: Measured) -> bool:
  """Tells whether two logs hold the same commands, each at the same time since its first."""
  times = [log.command_time - log.command_time[0] for log in (one, other)]
  lengths = [float(time[-1]) for time in times]
  period = float(np.median(np.diff(times[0]))) if len(times[0]) > 1 else 1.0
  grid = np.arange(0.0, min(lengths), period) + 0.5 * period
  values = [
    log.command[np.clip(np.searchsorted(time, grid) - 1, 0, None)]
    for log, time in zip((one, other), times, strict=True)
  ]
  apart = np.abs(values[0] - values[1])
  alike = abs(lengths[0] - lengths[1]) < 0.05 * max(lengths)
  return bool(alike and np.mean(apart > 1e-3 * max(np.ptp(values[0]), 1e-12)) < 0.05)
