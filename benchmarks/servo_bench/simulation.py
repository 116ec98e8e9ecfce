"""The servo and its arm in time: semi-implicit Euler at 25 us, the firmware every millisecond.

Compiled anew in every process, in seconds: a compiler's cache would not see changes of the laws in
other files.
"""

from typing import NamedTuple

import numba
import numpy as np

from benchmarks.servo_bench import arm, friction, gear, loop, motor

Array = np.ndarray

PARTS = 40
"""Steps between two runs of the firmware: 25 us, a fortieth of the stiffest teeth's oscillation."""
COUNTS, DUTY, CURRENT, SUPPLY, RISE, ANGLE, SPEED, ROTOR, ROTOR_SPEED, BRISTLE = range(10)
"""Columns of `simulate`: counts; steps; A; V; K; rad, rad/s of the arm, of the rotor; rad."""


class Bench(NamedTuple):
  """One servo with its arm."""

  motor: motor.Motor
  friction: friction.Friction
  gear: gear.Gear
  loop: loop.Loop
  arm: arm.Arm


@numba.njit
def simulate(bench: Bench, arrivals: Array, goals: Array, noise: Array, lead: float) -> Array:
  """Returns readings and state at every run of the firmware, [T, 10], from rest at the first goal.

  Args:
    bench: constants.
    arrivals: [K] s, rising, when goals reach the servo.
    goals: [K] int64, counts.
    noise: [T] standard normal draws for the encoder.
    lead: s before the clock of warming and fading starts.
  """
  m, f, g, firmware, a = bench.motor, bench.friction, bench.gear, bench.loop, bench.arm
  step = loop.PERIOD / PARTS
  ticks = noise.size
  rows = np.empty((ticks, 10))
  start = goals[0] * 2.0 * np.pi / firmware.counts - firmware.offset
  angle, speed, rotor, rotor_speed, tip, tip_speed = start, 0.0, start, 0.0, start, 0.0
  bristle, cable, rise, profile, latest = 0.0, 0.0, 0.0, float(goals[0]), 0
  hub = a.inertia * (1.0 - a.tip_share)
  tip_inertia = a.inertia * a.tip_share
  tip_stiffness = tip_inertia * a.tip_frequency**2
  tip_damping = 2.0 * a.tip_damping * tip_inertia * a.tip_frequency
  for tick in range(ticks):
    clock = max(tick * loop.PERIOD - lead, 0.0)
    while latest + 1 < goals.size and arrivals[latest + 1] <= tick * loop.PERIOD:
      latest += 1
    reading = loop.read(firmware, angle, noise[tick])
    older = int(rows[max(tick - loop.RATE_TICKS, 0), COUNTS]) if tick else reading
    profile = loop.approached(firmware, profile, goals[latest])
    steps = loop.duty(firmware, round(profile), reading, older)
    applied = steps / firmware.steps * max(1.0 - m.derating * rise, 0.2)
    if applied > 0.0:
      applied *= m.forward
    chill = friction.coldness(f, clock)
    amperes = motor.current(m, applied, rotor_speed, rise, clock)
    rows[tick, COUNTS], rows[tick, DUTY], rows[tick, CURRENT] = reading, steps, amperes
    rows[tick, SUPPLY], rows[tick, RISE] = motor.supply(m, applied, amperes, clock), rise
    rows[tick, ANGLE], rows[tick, SPEED] = angle, speed
    rows[tick, ROTOR], rows[tick, ROTOR_SPEED], rows[tick, BRISTLE] = rotor, rotor_speed, bristle
    for _ in range(PARTS):
      tooth = gear.teeth(g, rotor - angle, rotor_speed - speed)
      amperes = motor.current(m, applied, rotor_speed, rise, clock)
      fall = friction.stribeck(f, rotor_speed)
      dry = chill * friction.level(f, rotor_speed, tooth, angle, fall)
      bent = friction.bent(bristle, rotor_speed, dry, f.stiffness, step)
      rubbing = f.stiffness * bent + f.damping * fall * (bent - bristle) / step
      rubbing += chill * f.viscous * rotor_speed
      bristle = bent
      torque = tooth + arm.pull(a, angle, speed, cable)
      torque += (1.0 - a.tip_share) * arm.weight(a, angle)
      if a.tip_share > 0.0:
        held = tip_stiffness * (angle - tip) + tip_damping * (speed - tip_speed)
        torque -= held
        tip_speed += step * (held + a.tip_share * arm.weight(a, tip)) / tip_inertia
        tip += step * tip_speed
      rotor_speed += step * (m.constant * amperes - rubbing - tooth) / g.rotor
      speed += step * torque / hub
      rotor += step * rotor_speed
      angle += step * speed
      cable = min(max(cable + step * speed, -a.cable_slip), a.cable_slip)
      rise = motor.warmed(m, rise, amperes, step)
  return rows
