"""How a host logs a machine: rates, jitter, rounding, MCAP. T readings, C commands, n joints."""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from benchmarks.independent_sets.apparatus import Apparatus
from benchmarks.independent_sets.machine import Machine
from benchmarks.independent_sets.simulation import STEP, Trace
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log

Array = np.ndarray

EPOCH_NS = 1_750_000_000_000_000_000
_SUPPLY_PERIOD = 0.1  # s between readings of the supply
_VOLT = 0.05  # V, its resolution


@dataclasses.dataclass(frozen=True)
class Habits:
  """How one host reads."""

  period: float
  """s between readings."""
  jitter: float
  """s, standard deviation of when they are taken."""
  stamp_error: float
  """s, standard deviation of what their stamps are off by."""
  read_noise: float
  """Of the encoder, in its steps."""
  latency: float
  """s from the host to the drive."""
  skew: float
  """s that a reading is older than its stamp."""
  velocity_window: float
  """s over which speeds are differenced; 0: none are logged."""
  effort_noise: float
  """Share of the largest torque; 0: none are logged."""
  logs_duty: bool
  logs_supply: bool


def draw_habits(apparatus: Apparatus, rng: np.random.Generator) -> Habits:
  """Returns a host."""
  slow = apparatus.mode == "servo"
  period = float(rng.choice([0.005, 0.008, 0.01] if slow else [0.004, 0.005]))
  return Habits(
    period=period,
    jitter=period * rng.uniform(0.01, 0.08),
    stamp_error=rng.uniform(2e-5, 2e-4),
    read_noise=rng.uniform(0.1, 0.6),
    latency=rng.uniform(2e-4, 1.2e-3),
    skew=rng.uniform(0.0, 8e-4),
    velocity_window=float(rng.choice([0.0, 4 * period])),
    effort_noise=float(rng.choice([0.0, 0.005, 0.01])),
    logs_duty=slow and rng.random() < 0.5,
    logs_supply=slow and rng.random() < 0.7,
  )


@dataclasses.dataclass(frozen=True)
class Recording:
  """A log's content; times in s from the log's zero."""

  command_time: Array  # [C]
  command: Array  # [C, n]
  stamp: Array  # [T]
  position: Array  # [T, n]
  velocity: Array | None
  effort: Array | None
  duty: Array | None
  supply_time: Array
  supply: Array | None


def record(
  apparatus: Apparatus,
  machine: Machine,
  habits: Habits,
  *,
  trace: Trace,
  row: int,
  sent: Array,
  begin: float,
  duration: float,
  rng: np.random.Generator,
) -> Recording:
  """Reads one machine of a batch as its host would.

  Args:
    apparatus: the declared model of the host.
    machine: row `row` of the batch.
    habits: of the host.
    trace: the batch's motion.
    row: of the batch.
    sent: [C] s, when commands were sent, from the batch's start.
    begin: s at which the log begins, from the batch's start.
    duration: s.
    rng: of the noise.
  """
  count = int(duration / habits.period) - 1
  wanted = 1e-3 + habits.period * np.arange(count)
  jitter = habits.jitter * np.clip(rng.normal(size=count), -3, 3)
  taken = np.sort(np.maximum(wanted + jitter, 0.0))
  stamps = taken + habits.stamp_error * np.clip(rng.normal(size=count), -3, 3)
  stamps = np.maximum.accumulate(np.maximum(stamps, 1e-6))
  at = begin + taken - habits.skew
  late = at - float(machine.measurement_delay[0])

  def read(table: Array, times: Array) -> Array:
    place = np.clip(times / STEP, 0, len(table) - 1.001)
    low = place.astype(int)
    share = (place - low)[:, None]
    return (1 - share) * table[low, row] + share * table[low + 1, row]

  shaken = habits.read_noise * machine.count * rng.normal(size=(count, len(machine.count)))
  position = np.round((read(trace.position, late) + shaken) / machine.count) * machine.count
  velocity = effort = None
  if habits.velocity_window:
    before = read(trace.position, late - habits.velocity_window) + shaken[::-1]
    before = np.round(before / machine.count) * machine.count
    velocity = (position - before) / habits.velocity_window
  if habits.effort_noise:
    nominal = apparatus.nominal
    most = nominal.nominal_constant * np.minimum(
      nominal.current_limit, nominal.volts / nominal.resistance
    )
    effort = read(trace.current, at) * nominal.nominal_constant
    effort += habits.effort_noise * most * rng.normal(size=effort.shape)
  chosen = sent >= begin - 1e-9
  supply_time = np.arange(0.0, duration - 0.05, _SUPPLY_PERIOD)
  volts = read(trace.volts, begin + supply_time)[:, 0]
  return Recording(
    command_time=sent[chosen] - begin,
    command=trace.commands[chosen, row],
    stamp=stamps,
    position=position,
    velocity=velocity,
    effort=effort,
    duty=read(trace.duty, at) if habits.logs_duty else None,
    supply_time=supply_time,
    supply=np.round(volts / _VOLT) * _VOLT if habits.logs_supply else None,
  )


def write(path: pathlib.Path, apparatus: Apparatus, recording: Recording) -> None:
  """Writes a recording as a measured log, messages in the order of their stamps."""
  joints, effort_command = apparatus.joints, apparatus.mode == "current"
  rows: list[tuple[float, int, int]] = [(t, 0, i) for i, t in enumerate(recording.command_time)]
  rows += [(t, 1, i) for i, t in enumerate(recording.stamp)]
  if recording.supply is not None:
    rows += [(t, 2, i) for i, t in enumerate(recording.supply_time)]

  def of(table: Array | None, index: int) -> Any:
    return None if table is None else table[index]

  with open_log(path) as log:
    for time, kind, index in sorted(rows):
      moment = EPOCH_NS + round(time * 1e9)
      if kind == 0:
        values = recording.command[index]
        field = {"effort" if effort_command else "position": values}
        log.write(messages.joint_state(moment, messages.COMMANDS, joints, **field))
      elif kind == 1:
        states = messages.joint_state(
          moment,
          messages.STATES,
          joints,
          position=recording.position[index],
          velocity=of(recording.velocity, index),
          effort=of(recording.effort, index),
        )
        log.write(states)
        if recording.duty is not None:
          duty = recording.duty[index]
          log.write(messages.joint_state(moment, messages.PWM, joints, effort=duty))
      else:
        assert recording.supply is not None
        log.write(messages.battery(moment, float(recording.supply[index])))
