"""The host of the drives: sends goals, reads encoders, and keeps what it heard as MCAP."""

import pathlib
from typing import NamedTuple

import numpy as np

from benchmarks.drive_axes import mechanics, simulation
from benchmarks.drive_axes.following import LEAD
from benchmarks.drive_axes.plants import Machine
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log

Array = np.ndarray
Random = np.random.Generator
EPOCH = 1_780_000_000
"""s since 1970, of the first log."""


class Host(NamedTuple):
  """How a host talks to the drives and what it is told."""

  period: float  # s, between readings
  skipped: int  # readings from one command to the next
  per_tick: int  # steps of the simulation from one run of the drives to the next
  latency: float  # s, from a command's stamp to the drive
  age: float  # s, of a reading at its stamp
  jitter: float  # s, standard deviation of when things happen
  speeds: bool  # whether speeds are logged
  efforts: bool
  effort_steps: float  # of the largest torque, by which the current is told
  command_delay: float = 0.0  # s, beyond the latency
  reading_delay: float = 0.0  # s, that positions and speeds are older
  clock_rate: float = 0.0  # s a second that stamps gain


class Recording(NamedTuple):
  """One log: M commands, N readings of n joints; times in s since its start."""

  sent: Array  # [M]
  commands: Array  # [M, n] rad or m
  time: Array  # [N]
  stamp: Array  # [N], as the header says
  position: Array  # [N, n]
  speed: Array  # [N, n]
  effort: Array  # [N, n] N m or N
  full: float
  """Share of the time in which a torque is limited."""


def draw_host(random: Random) -> Host:
  """Returns a host of 100 to 500 Hz and drives of 2 or 4 kHz."""
  rate = int(random.choice([100, 125, 200, 250, 500]))
  return Host(
    period=1.0 / rate,
    skipped=int(random.choice([1, 2] if rate < 250 else [2, 5])),
    per_tick=int(random.choice([5, 10])),
    latency=random.uniform(3e-4, 2e-3),
    age=random.uniform(1e-4, 8e-4),
    jitter=random.uniform(3e-5, 2e-4),
    speeds=bool(random.uniform() < 0.6),
    efforts=bool(random.uniform() < 0.6),
    effort_steps=1e-3 * random.uniform(0.5, 2.0),
  )


def lateness(host: Host) -> float:
  """Returns the usual time [s] from a command to a reading of what it did: the bus and half a run
  of the drive. Lags within the loops do not delay slow motions: position follows by 1 / Kp."""
  return host.latency + host.age + 0.5 * host.per_tick * simulation.STEP


def command_times(host: Host, duration: float) -> Array:
  """Returns when commands are sent [M] s."""
  every = host.period * host.skipped
  return every * np.arange(round(duration / every))


def record(machine: Machine, host: Host, commands: Array, random: Random) -> Recording:
  """Returns what a host hears of a machine that it gives commands [M, n]."""
  every, tick = host.period * host.skipped, host.per_tick * simulation.STEP
  sent = every * np.arange(len(commands))
  duration = every * len(commands)
  away = LEAD + random.uniform(0.0, tick)  # of the host's zero on the drives' clock
  late = host.latency + host.command_delay + host.jitter * np.abs(random.standard_normal(sent.size))
  arrivals = np.maximum.accumulate(sent + late + away)
  ticks = round((away + duration + 0.02) / tick)
  which = np.searchsorted(arrivals, tick * np.arange(ticks), side="right") - 1
  goals = np.ascontiguousarray(commands[np.clip(which, 0, None)])
  noise = random.standard_normal(goals.shape)
  of = mechanics.coefficients(machine.plant, machine.links)
  rows = simulation.simulate(machine.axes, of, goals, noise, host.per_tick, away)
  count = round(duration / host.period)
  wait = np.clip(host.jitter * random.standard_normal(count), -1e-3, 1e-3)
  read = np.maximum(host.period * np.arange(count) + wait, 0.0)
  now = ((read + away - host.age) / tick).astype(int)
  seen = ((read + away - host.age - host.reading_delay) / tick).astype(int)
  position = rows[:, :, simulation.READING]
  span = max(round(5e-3 / tick), 1)
  unit = host.effort_steps * machine.axes.limit
  return Recording(
    sent=sent,
    commands=commands,
    time=read,
    stamp=read * (1.0 + host.clock_rate),
    position=position[seen],
    speed=(position[seen] - position[seen - span]) / (span * tick),
    effort=unit * np.round(rows[now, :, simulation.CURRENT] / unit),
    full=float(np.mean(rows[:, :, simulation.FULL])),
  )


def write(path: pathlib.Path, log: Recording, host: Host, joints: tuple[str, ...], start: int):
  """Writes a log whose first second is `start`, s since 1970."""

  def ns(time: float) -> int:
    return start * messages.SECOND + round(time * 1e9)

  told = [
    (ns(time), messages.joint_state(ns(time), messages.COMMANDS, joints, position=goal))
    for time, goal in zip(log.sent, log.commands, strict=True)
  ]
  for k, time in enumerate(log.time):
    state = messages.joint_state(
      ns(log.stamp[k]),
      messages.STATES,
      joints,
      position=log.position[k],
      velocity=log.speed[k] if host.speeds else None,
      effort=log.effort[k] if host.efforts else None,
    )
    told.append((ns(time), state))
  with open_log(path) as writer:
    for heard, message in sorted(told, key=lambda entry: entry[0]):
      writer.write(message, log_ns=heard)
