"""Runs a machine under commands and records it as a host on its bus would. T messages, J joints."""

import dataclasses
import pathlib

import numpy as np

from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log

from .apparatus import Apparatus
from .machine import Machine, Reading
from .plant import COUNTS_PER_RADIAN, simulate

VELOCITY_STEP = 0.229 * 2 * np.pi / 60
"""rad/s (XM430 control table: 0.229 rpm)."""
EFFORT_STEP = 2.69e-3 * 4.1 / 2.3
"""N m: 2.69 mA (control table) at the torque constant of stall, 4.1 N m at 2.3 A (data sheet)."""
SETTLING = 0.8
"""s before a log in which a settled machine comes to rest under load."""
AMBIENT = 34.0
"""Degrees Celsius."""
EPOCH_NS = 1_700_000_000_000_000_000
_PERIODIC = 0.1  # s between messages of supply and temperature


@dataclasses.dataclass(frozen=True)
class Recording:
  """A log's content; times in s from the log's zero."""

  command_time: np.ndarray
  """[C]."""
  command: np.ndarray
  """[C, J] rad."""
  stamp: np.ndarray
  """[T]."""
  log_time: np.ndarray
  """[T]."""
  position: np.ndarray
  """[T, J] rad."""
  velocity: np.ndarray
  """[T, J] rad/s."""
  effort: np.ndarray
  """[T, J] N m."""
  duty: np.ndarray
  """[T, J]."""
  slow_time: np.ndarray
  """[B]."""
  volts: np.ndarray
  """[B]."""
  celsius: np.ndarray
  """[B, J]."""


def record(
  apparatus: Apparatus,
  machine: Machine,
  reading: Reading,
  *,
  commands: np.ndarray,
  seed: tuple[int, ...],
) -> Recording:
  """Drives a machine with commands at `reading.command_period` and returns the recording.

  Args:
    apparatus: for the integrator's step.
    machine: what is driven.
    reading: how it is read.
    commands: [C, J] rad.
    seed: of the noise; the same noise is drawn whatever the machine has.
  """
  rng = np.random.default_rng(seed)
  count = commands.shape[1]
  command_time = np.arange(len(commands)) * reading.command_period
  duration = len(commands) * reading.command_period
  arrivals = command_time + rng.uniform(0.5e-4, 3e-4, len(commands))
  messages = round(duration / reading.state_period)
  nominal = np.arange(messages) * reading.state_period + 1e-3
  host = nominal + rng.uniform(-1, 1, messages) * reading.stamp_jitter
  if reading.whole_milliseconds:
    host = np.round(host, 3)
  host = np.maximum(host, 0.0)
  per_second = machine.world.ticks_per_second
  start = (-SETTLING if reading.settled else 0.0) + rng.uniform(0, 1 / per_second)
  ticks = int(np.ceil((duration + 0.02 - start) * per_second))
  noise = rng.normal(0, reading.encoder_noise, (ticks, count))
  read = host[:, None] + np.clip(rng.normal(0, 1, (messages, 1)), -3, 3) * reading.read_jitter
  read = read + np.arange(count) * reading.read_skew
  stale = rng.random((messages, count)) < reading.stale
  velocity_noise = rng.normal(0, reading.velocity_noise, (messages, count))
  effort_noise = rng.normal(0, reading.effort_noise, (messages, count))

  trace = simulate(
    machine.tree,
    machine.servo,
    world=machine.world,
    start_angles=commands[0],
    arrivals=arrivals,
    commands=commands,
    start=start,
    ticks=ticks,
    step=apparatus.step,
    encoder_noise=noise,
    dropouts=np.array(machine.dropouts, float).reshape(-1, 3) if machine.dropouts else None,
  )

  def at(times: np.ndarray) -> np.ndarray:
    """Returns the ticks whose tables are read at times [T, J]."""
    index = np.floor((times - start) * per_second).astype(int)
    return np.clip(index, 0, ticks - 1)

  late = at(read - machine.measurement_delay)
  now = at(read)
  for index in range(1, messages):
    late[index] = np.where(stale[index], late[index - 1], late[index])
    now[index] = np.where(stale[index], now[index - 1], now[index])
  window = reading.velocity_ticks
  padded = np.concatenate([np.zeros((window, count)), trace.velocity]).cumsum(axis=0)
  velocity = (padded[window:] - padded[:-window]) / window
  slow_time = np.arange(0.0, duration, _PERIODIC)
  slow = at(slow_time[:, None])[:, 0]
  effort = trace.effort * machine.effort_scale

  def pick(table: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.take_along_axis(table, rows, axis=0)

  drifted = host * (1 + machine.clock_rate)
  return Recording(
    command_time=command_time,
    command=commands,
    stamp=drifted,
    log_time=host if machine.stamps_only else drifted,
    position=pick(trace.position, late) / COUNTS_PER_RADIAN,
    velocity=_round(pick(velocity, late) + velocity_noise, VELOCITY_STEP),
    effort=_round(pick(effort, now) + effort_noise, EFFORT_STEP),
    duty=pick(trace.duty, now),
    slow_time=slow_time,
    volts=_round(trace.volts[slow], 0.1),
    celsius=np.floor(AMBIENT + trace.temperature_rise[slow]),
  )


def write(path: pathlib.Path, joints: list[str], recording: Recording, reading: Reading) -> None:
  """Writes a recording as a measured log, messages in the order of their log times."""
  rows: list[tuple[float, int, int]] = []
  rows += [(time, 0, index) for index, time in enumerate(recording.command_time)]
  rows += [(time, 1, index) for index, time in enumerate(recording.log_time)]
  rows += [(time, 2, index) for index, time in enumerate(recording.slow_time)]
  with open_log(path) as log:
    for time, kind, index in sorted(rows):
      moment = _ns(time)
      if kind == 0:
        commands = recording.command[index]
        log.write(messages.joint_state(moment, messages.COMMANDS, joints, position=commands))
      elif kind == 1:
        stamp = _ns(recording.stamp[index])
        states = messages.joint_state(
          stamp,
          messages.STATES,
          joints,
          position=recording.position[index],
          velocity=recording.velocity[index],
          effort=recording.effort[index],
        )
        log.write(states, log_ns=moment)
        if reading.with_duty:
          duty = messages.joint_state(stamp, messages.PWM, joints, effort=recording.duty[index])
          log.write(duty, log_ns=moment)
      else:
        log.write(messages.battery(moment, recording.volts[index]))
        if reading.with_temperature and index % 5 == 0:
          for joint, celsius in zip(joints, recording.celsius[index], strict=True):
            log.write(messages.temperature(moment, joint, celsius))


def _ns(seconds: float) -> int:
  return EPOCH_NS + round(seconds * 1e9)


def _round(values: np.ndarray, step: float) -> np.ndarray:
  return np.round(values / step) * step
