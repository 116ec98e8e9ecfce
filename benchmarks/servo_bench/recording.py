"""The host beside the bench: sends commands, reads the servo, and keeps what it heard as MCAP."""

import math
import pathlib
from typing import NamedTuple

import numpy as np

from benchmarks.servo_bench import bench as benches
from benchmarks.servo_bench import loop, simulation
from benchmarks.servo_bench.motor import Motor
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log

Array = np.ndarray
Random = np.random.Generator

LEAD = 1.0
"""s before a log in which the servo holds its first goal."""
EPOCH = 1_760_000_000
"""s since 1970, of the first log."""
SPEED_TICKS, SPEED_STEP = 16, 0.024
"""Runs of the firmware over which it takes its speed, and rad/s of one unit of it."""
_CASE_TIME = 8.0
"""s, in which the case that has the thermometer follows the winding."""


class Host(NamedTuple):
  """How a host talks to one servo and what the servo tells it."""

  period: float
  """s, between readings."""
  skipped: int
  """Readings between commands, plus one."""
  latency: float
  """s, from a command's stamp to the servo."""
  age: float
  """s, of a reading at its stamp."""
  jitter: float
  """s, standard deviation of when things happen."""
  speeds: bool
  """Whether speeds are logged, and so on."""
  efforts: bool
  duties: bool
  voltages: bool
  temperatures: bool
  newton_metres: float
  """N m/A, by which the host makes efforts of currents: the datasheet's."""
  ampere_unit: float
  """A, of one unit of the current that the servo tells."""
  command_delay: float = 0.0
  """s, beyond the latency."""
  reading_delay: float = 0.0
  """s, that angles and speeds are older."""
  clock_rate: float = 0.0
  """s a second that the readings' stamps gain."""
  stall_period: float = 1.0
  """s, from one stall of the sender to the next."""
  stall: float = 0.0
  """s, for which it holds commands back."""


class Recording(NamedTuple):
  """One log: M commands, N readings; times in s since the start."""

  command_time: Array  # [M]
  command: Array  # [M] rad
  time: Array  # [N], when read
  stamp: Array  # [N], as the header says
  angle: Array  # [N] rad
  speed: Array  # [N] rad/s
  effort: Array  # [N] N m
  duty: Array  # [N]
  voltage: Array  # [N] V
  celsius: Array  # [N]


def draw_host(motor: Motor, random: Random) -> Host:
  """Returns a host of 50 to 200 Hz; what the servo can tell differs.

  Args:
    motor: on paper.
    random: generator.
  """
  period = 1.0 / random.choice([50.0, 100.0, 100.0, 125.0, 200.0])
  return Host(
    period=period,
    skipped=1 if period > 0.015 else int(random.integers(1, 3)),
    latency=random.uniform(3e-4, 2.5e-3),
    age=random.uniform(2e-4, 1.5e-3),
    jitter=random.uniform(5e-5, 3e-4),
    speeds=random.uniform() < 0.6,
    efforts=random.uniform() < 0.5,
    duties=random.uniform() < 0.5,
    voltages=random.uniform() < 0.6,
    temperatures=random.uniform() < 0.3,
    newton_metres=motor.constant,
    ampere_unit=motor.voltage / motor.resistance / 800.0,
  )


def lateness(host: Host) -> float:
  """Returns the usual time [s] from a command to a reading of what it did, both as stamped."""
  return host.latency + host.age + loop.PERIOD


def command_times(host: Host, duration: float) -> Array:
  """Returns when commands are sent [M] s."""
  every = host.period * host.skipped
  return every * np.arange(round(duration / every))


def record(bench: simulation.Bench, host: Host, command: Array, random: Random) -> Recording:
  """Returns what a host hears of a bench that it gives commands [M] rad."""
  every = host.period * host.skipped
  sent, duration = every * np.arange(command.size), every * command.size
  late = host.latency + host.command_delay + host.jitter * np.abs(random.standard_normal(sent.size))
  away = LEAD + random.uniform(0.0, loop.PERIOD)  # of the host's zero on the servo's clock
  leaves = sent
  if host.stall > 0.0:
    into = np.mod(sent, host.stall_period)
    leaves = sent + np.maximum(host.stall - into, 0.0) * (sent >= host.stall_period)
  arrivals = np.maximum.accumulate(leaves + late + away)
  turn = bench.loop.counts / math.tau
  goals = np.round(command * turn).astype(np.int64)
  noise = random.standard_normal(round((away + duration + 0.05) / loop.PERIOD))
  rows = simulation.simulate(bench, arrivals, goals, noise, LEAD)
  count = round(duration / host.period)
  wait = host.jitter * random.standard_normal(count)
  read = np.maximum(np.arange(count) * host.period + np.clip(wait, -1e-3, 1e-3), 0.0)
  now = ((read + away - host.age) / loop.PERIOD).astype(int)
  seen = ((read + away - host.age - host.reading_delay) / loop.PERIOD).astype(int)
  counts = rows[:, simulation.COUNTS]
  rate = (counts[seen] - counts[seen - SPEED_TICKS]) / turn / (SPEED_TICKS * loop.PERIOD)
  amperes = host.ampere_unit * np.round(rows[now, simulation.CURRENT] / host.ampere_unit)
  return Recording(
    command_time=sent,
    command=command,
    time=read,
    stamp=read * (1.0 + host.clock_rate),
    angle=counts[seen] / turn,
    speed=SPEED_STEP * np.round(rate / SPEED_STEP),
    effort=amperes * host.newton_metres,
    duty=rows[now, simulation.DUTY] / bench.loop.steps,
    voltage=np.round(rows[now, simulation.SUPPLY], 1),
    celsius=np.round(28.0 + _case(rows[:, simulation.RISE])[now]),
  )


def _case(rise: Array) -> Array:
  """Returns the case's rise [T] K: half the winding's, late by a first order."""
  case, share = np.empty_like(rise), loop.PERIOD / _CASE_TIME
  value = 0.0
  for k, winding in enumerate(rise.tolist()):
    value += share * (0.5 * winding - value)
    case[k] = value
  return case


def write(path: pathlib.Path, log: Recording, host: Host, *, start: int) -> None:
  """Writes a log whose first second is `start`, s since 1970."""
  zero = start * messages.SECOND
  names = [benches.JOINT]

  def ns(time: float) -> int:
    return zero + round(time * 1e9)

  told: list[tuple[int, messages.Message]] = [
    (ns(t), messages.joint_state(ns(t), messages.COMMANDS, names, position=[c]))
    for t, c in zip(log.command_time, log.command, strict=True)
  ]
  tenth, second = (max(round(every / host.period), 1) for every in (0.1, 1.0))
  for k, time in enumerate(log.time):
    stamp, heard = ns(log.stamp[k]), ns(time)
    state = messages.joint_state(
      stamp,
      messages.STATES,
      names,
      position=[log.angle[k]],
      velocity=[log.speed[k]] if host.speeds else None,
      effort=[log.effort[k]] if host.efforts else None,
    )
    told.append((heard, state))
    if host.duties:
      pwm = messages.joint_state(stamp, messages.PWM, names, effort=[log.duty[k]])
      told.append((heard, pwm))
    if host.voltages and k % tenth == 0:
      told.append((heard, messages.battery(stamp, log.voltage[k])))
    if host.temperatures and k % second == 0:
      told.append((heard, messages.temperature(stamp, benches.JOINT, log.celsius[k])))
  with open_log(path) as writer:
    for heard, message in sorted(told, key=lambda entry: entry[0]):
      writer.write(message, log_ns=heard)
