"""The host: sends goals over a bus, polls the servos, and keeps what it heard as MCAP."""

import math
import pathlib
from typing import NamedTuple

import numpy as np

from benchmarks.hobby_joints import servos
from benchmarks.hobby_joints.following import LEAD
from benchmarks.hobby_joints.machines import Machine
from nerf2real.core.robot_logs import messages
from nerf2real.core.robot_logs.writer import open_log

Array = np.ndarray
Random = np.random.Generator
EPOCH = 1_790_000_000
"""s since 1970, of the first log."""
_SENSOR_NOISE = 0.25  # steps of the sensor, standard deviation
_VOLTAGE_STEP = 0.1  # V, as servos tell it


class Host(NamedTuple):
  """How a host talks to the servos."""

  rate: float  # Hz, of readings
  skipped: int  # readings from one command to the next
  per_tick: int  # steps of the simulation in a run of the firmware
  latency: float  # s, from a command's stamp to the servo
  age: float  # s, of a reading at its stamp
  jitter: float  # s, standard deviation of stamps and arrivals
  dropped: float  # share of readings that get lost
  speeds: bool  # whether it logs them
  efforts: bool
  duties: bool
  volts: bool
  printed: tuple[float, ...]  # printed over true torque constant, by joint
  command_delay: float = 0.0  # s, beyond the latency
  reading_delay: float = 0.0  # s, that positions and speeds are older
  clock_rate: float = 0.0  # s a second that stamps of readings gain


class Recording(NamedTuple):
  """One log: M commands, N readings of n joints; times in s since its start."""

  sent: Array  # [M]
  commands: Array  # [M, n]
  time: Array  # [N]
  stamp: Array  # [N], as the header says
  position: Array  # [N, n]
  speed: Array  # [N, n]
  effort: Array  # [N, n]
  duty: Array  # [N, n]
  voltage: Array  # [N]


def draw_host(joints: int, random: Random) -> Host:
  """Returns a host that reads at 100 to 250 Hz and commands at 50 to 200 Hz."""
  rate = float(random.choice([100.0, 125.0, 200.0, 250.0]))
  return Host(
    rate=rate,
    skipped=int(random.choice([1, 2])) if rate <= 200.0 else 2,
    per_tick=int(random.choice([10, 20, 20, 40])),
    latency=random.uniform(0.0, 2e-3),
    age=random.uniform(0.0, 1e-3),
    jitter=random.uniform(5e-5, 3e-4),
    dropped=float(random.choice([0.0, 0.0, 0.004])),
    speeds=bool(random.uniform() < 0.5),
    efforts=bool(random.uniform() < 0.5),
    duties=bool(random.uniform() < 0.3),
    volts=bool(random.uniform() < 0.4),
    printed=tuple(1.0 + 0.03 * random.standard_normal(joints)),
  )


def lateness(host: Host) -> float:
  """Returns the usual time [s] from a command to a reading of what it did: the bus, and half a run
  of the firmware before it hears and after it reads."""
  return host.latency + host.age + host.per_tick * servos.STEP


def command_times(host: Host, duration: float) -> Array:
  """Returns when commands are sent [M] s."""
  every = host.skipped / host.rate
  return every * np.arange(round(duration / every))


def record(machine: Machine, host: Host, commands: Array, random: Random) -> Recording:
  """Returns what a host hears of a machine that it gives commands [M, n]."""
  tick, n = host.per_tick * servos.STEP, commands.shape[1]
  sent = host.skipped / host.rate * np.arange(len(commands))
  lead = LEAD + random.uniform(0.0, tick)  # the host's zero on the firmware's clock
  late = host.latency + host.jitter * np.abs(random.standard_normal(sent.size))
  arrivals = np.maximum.accumulate(sent + late + host.command_delay + lead)
  duration = host.skipped / host.rate * len(commands)
  ticks = math.ceil((lead + duration + 0.01) / tick)
  which = np.searchsorted(arrivals, tick * np.arange(ticks), side="right") - 1
  goals = np.ascontiguousarray(commands[np.maximum(which, 0)])
  noise = _SENSOR_NOISE * random.standard_normal((ticks, n))
  parts = (machine.body, machine.drive, machine.gear, machine.supply)
  rows = servos.simulate(*parts, goals, noise, host.per_tick, lead)
  count = round(duration * host.rate)
  shake = np.clip(host.jitter * random.standard_normal(count), -1e-3, 1e-3)
  time = np.maximum(np.arange(count) / host.rate + shake, 0.0)
  time = time[random.uniform(size=count) >= host.dropped]
  now = ((time + lead - host.age) / tick).astype(int)
  seen = ((time + lead - host.age - host.reading_delay) / tick).astype(int)
  position, span = rows[:, :, servos.READING], max(round(0.01 / tick), 1)
  unit = 1e-3 * machine.stall
  effort = rows[now, :, servos.CURRENT] * machine.drive.constant * np.array(host.printed)
  return Recording(
    sent=sent,
    commands=commands,
    time=time,
    stamp=time * (1.0 + host.clock_rate),
    position=position[seen],
    speed=(position[seen] - position[seen - span]) / (span * tick),
    effort=unit * np.round(effort / unit),
    duty=np.round(rows[now, :, servos.DUTY], 3),
    voltage=_VOLTAGE_STEP * np.round(rows[now, 0, servos.VOLTAGE] / _VOLTAGE_STEP),
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
    heard, stamp = ns(time), ns(log.stamp[k])
    state = messages.joint_state(
      stamp,
      messages.STATES,
      joints,
      position=log.position[k],
      velocity=log.speed[k] if host.speeds else None,
      effort=log.effort[k] if host.efforts else None,
    )
    told.append((heard, state))
    if host.duties:
      duty = messages.joint_state(stamp, messages.PWM, joints, effort=log.duty[k])
      told.append((heard, duty))
    if host.volts and k % 10 == 0:
      told.append((heard, messages.battery(stamp, log.voltage[k])))
  with open_log(path) as writer:
    for heard, message in sorted(told, key=lambda entry: entry[0]):
      writer.write(message, log_ns=heard)
