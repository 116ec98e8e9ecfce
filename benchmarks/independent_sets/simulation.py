"""Integrates a batch of machines: rotor, gear with play and link at every joint, one fixed step.

Mechanics by the explicit midpoint rule, windings exactly for a held voltage; controllers run at
their own ticks, the host at its own. All machines of a batch advance together, in numpy.

Shapes: B machines, n joints, T steps, C commands.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from benchmarks.independent_sets import bodies
from benchmarks.independent_sets.drives import Drive
from benchmarks.independent_sets.friction import Friction

Array = np.ndarray

STEP = 2e-4
"""s; chosen: a tenth of the period of the stiffest gear of `apparatus`, halved."""
Host = Callable[[int, Array], Array]
"""Makes a command [B, n] of its number and the encoder's positions [B, n]."""


@dataclasses.dataclass(frozen=True)
class Trace:
  """A motion, a row a step; times from the batch's start."""

  position: Array  # [T, B, n] of the encoder before rounding
  link: Array  # [T, B, n] true
  current: Array  # [T, B, n] A
  duty: Array  # [T, B, n]
  volts: Array  # [T, B, n]
  commands: Array  # [C, B, n] as the host sent them


def simulate(
  machine,
  *,
  mode: str,
  start: Array,
  sent: Array,
  commands: Array | Host,
  steps: int,
  tick: int,
) -> Trace:
  """Runs a batch of machines.

  Args:
    machine: constants of B machines.
    mode: of `drives.Drive`.
    start: [B, n] positions at rest.
    sent: [C] step at which the host sends each command, increasing.
    commands: [C, B, n], or a host that computes each from what the encoder reads.
    steps: how many.
    tick: steps between two runs of the controllers.
  """
  accelerate = bodies.carriage if machine.slides else bodies.chain
  arrives = sent[:, None] + np.round(machine.command_delay[:, 0] / STEP).astype(int)
  rows = np.arange(len(start))
  last = np.full(len(start), -1)
  q, v, rotor, rate = start.copy(), np.zeros_like(start), start.copy(), np.zeros_like(start)
  drive, friction = Drive(machine, mode, step=STEP), Friction(machine)
  history = np.zeros((5, steps, *start.shape))
  given = np.zeros((len(sent), *start.shape)) if callable(commands) else commands
  late = np.round(machine.measurement_delay[:, 0] / STEP).astype(int)
  due = 0
  command = given[0] if not callable(commands) else np.zeros_like(start)
  for index in range(steps):
    shift = machine.zero + machine.zero_drift * (1 - np.exp(-index * STEP / machine.drift_time))
    encoder = q + shift
    history[0, index], history[1, index] = encoder, q
    while due < len(sent) and sent[due] <= index:
      if callable(commands):
        seen = history[0, np.maximum(index - late, 0), rows]
        given[due] = commands(due, _counted(seen, machine.count))
      due += 1
    if index % tick == 0:
      while True:
        more = (last + 1 < due) & (arrives[np.minimum(last + 1, len(sent) - 1), rows] <= index)
        if not more.any():
          break
        last = last + more
      command = np.where((last >= 0)[:, None], given[np.maximum(last, 0), rows], command)
      counts = _counted(encoder, machine.count), _counted(rotor, machine.count)
      drive.tick(command, *counts, period=tick * STEP)
    torque = drive.advance(rate, time=index * STEP)
    history[2, index], history[3, index] = drive.current, drive.duty
    history[4, index] = drive.volts
    q, v, rotor, rate = _midpoint(machine, accelerate, friction, torque, (q, v, rotor, rate))
  path, link, current, duty, volts = history
  return Trace(path, link, current, duty, volts, given)


def _counted(position: Array, count: Array) -> Array:
  return np.round(position / count) * count


def _midpoint(machine, accelerate, friction: Friction, torque: Array, state: tuple) -> tuple:
  """Returns link and rotor, positions and velocities, one step on."""
  q, v, rotor, rate = state
  limit = friction.steady(rotor, rate)
  held = friction.force.sum(axis=0)
  slow, quick = _accelerations(machine, accelerate, torque - held, state)
  half = 0.5 * STEP
  middle = (q + half * v, v + half * slow, rotor + half * rate, rate + half * quick)
  held = friction.ahead(half * rate, limit).sum(axis=0)
  slow, quick = _accelerations(machine, accelerate, torque - held, middle)
  move = STEP * middle[3]
  friction.advance(move, limit, step=STEP)
  return q + STEP * middle[1], v + STEP * slow, rotor + move, rate + STEP * quick


def _accelerations(machine, accelerate, torque: Array, state: tuple) -> tuple[Array, Array]:
  """Returns the accelerations of links and rotors; the torque on the rotors includes friction."""
  q, v, rotor, rate = state
  apart = rotor - q
  half = machine.half_gap
  wound = apart - np.minimum(np.maximum(apart, -half), half)
  damped = machine.gear_stiffness * wound + machine.gear_damping * (rate - v)
  # Teeth push and never pull: damping cannot turn the contact's force round.
  passed = np.where(wound > 0, np.maximum(damped, 0.0), np.minimum(damped, 0.0))
  gear = np.where(half > 0, np.where(wound == 0, 0.0, passed), damped)
  spring = machine.spring * np.maximum(q - machine.spring_begins, 0.0)
  link = accelerate(machine, q, v, gear - spring)
  return link, (torque - gear - machine.viscous * rate) / machine.rotor
