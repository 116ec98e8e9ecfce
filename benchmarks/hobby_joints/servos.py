"""Motor, firmware, gear and links together, 50 us a step: Euler's method, speeds first.

A brushed motor on a PWM bridge, as seen at the output: L di/dt = duty V - R i - k w, torque k i.
The firmware samples its angle sensor, holds the duty until its next run, and knows P and D alone.
"""

from typing import NamedTuple

import numba
import numpy as np

from benchmarks.hobby_joints import bodies, gears
from benchmarks.hobby_joints.bodies import Body
from benchmarks.hobby_joints.gears import Gear

Array = np.ndarray
STEP = 5e-5  # s
_BRISTLE_DAMPING = 0.6  # of twice the critical, bristles against the rotor
_LOOSE_STIFFNESS = 4e4  # 1/s^2 times the loose inertia: it knocks within 5 ms
READING, CURRENT, DUTY, VOLTAGE, LINK, SPEED = range(6)
"""Columns of what `simulate` returns."""


class Drive(NamedTuple):
  """Constants of motors and firmware, [n] each, at the output: rad and N m, of a jaw m and N."""

  constant: Array  # N m/A, V s/rad
  resistance: Array  # Ohm
  lag: Array  # s, L/R; 0: none
  rotor: Array  # kg m^2
  proportional: Array  # duty per rad
  derivative: Array  # duty s/rad
  smooth: Array  # s, filter of the derivative
  most: Array  # duty
  notch: Array  # rad a step of the sensor
  offset: Array  # rad that it reads too much
  on_rotor: Array  # 1 where it sits before the hub that may slip
  dead_band: Array  # rad of error that is left
  top_speed: Array  # rad/s of a trapezoidal profile of goals
  ramp: Array  # rad/s^2 of that
  heating: Array  # K/(s N^2 m^2)
  cooling: Array  # s
  foldback: Array  # 1/K of the duty


class Supply(NamedTuple):
  """What feeds all bridges."""

  voltage: float  # V
  resistance: float  # Ohm
  fade: float  # 1/s of the voltage


@numba.njit(cache=True)
def profiled(goals: Array, drive: Drive, tick: float) -> Array:
  """Returns goals [T, n] as a trapezoidal profile of speed and acceleration lets them through."""
  out = goals.copy()
  for j in range(goals.shape[1]):
    top, ramp = drive.top_speed[j], drive.ramp[j]
    if not np.isfinite(top):
      continue
    place, speed = goals[0, j], 0.0
    for t in range(goals.shape[0]):
      left = goals[t, j] - place
      # The speed from which a ramp ends at the goal.
      wish = np.sign(left) * min(top, np.sqrt(2.0 * ramp * abs(left)), abs(left) / tick)
      speed += min(max(wish - speed, -ramp * tick), ramp * tick)
      place += speed * tick
      out[t, j] = place
  return out


@numba.njit(cache=True)
def simulate(
  body: Body,
  drive: Drive,
  gear: Gear,
  supply: Supply,
  goals: Array,
  noise: Array,
  per_tick: int,
  lead: float,
) -> Array:
  """Returns rows [T, n, 6] at every run of the firmware, from rest at the first goal.

  Args:
    body: the links.
    drive: motors and firmware.
    gear: gears.
    supply: what feeds them.
    goals: [T, n] as they have arrived.
    noise: [T, n] of the sensor in its steps.
    per_tick: steps from one run of the firmware to the next.
    lead: s before the log begins, in which batteries and windings stay as they are.
  """
  ticks, n = goals.shape
  tick = per_tick * STEP
  goals = profiled(goals, drive, tick)
  rows = np.zeros((ticks, n, 6))
  q, v = goals[0].copy(), np.zeros(n)
  rotor, spin = q.copy(), np.zeros(n)
  loose, loose_speed = q.copy(), np.zeros(n)
  z, current, duty, rate, rise, bundle, slipped = np.zeros((7, n))
  last, pushed, link, acceleration = q + drive.offset, np.zeros(n), np.zeros(n), np.zeros(n)
  held = gear.dry + gear.rest + gear.more_rest + 0.5 * (gear.forward + gear.backward)
  stiff = held / gear.reach
  soft = _BRISTLE_DAMPING * np.sqrt(stiff * drive.rotor)
  volts = supply.voltage
  for t in range(ticks):
    for j in range(n):
      seen = rotor[j] if drive.on_rotor[j] > 0.0 else q[j]
      seen = (seen + drive.offset[j]) / drive.notch[j] + noise[t, j]
      reading = drive.notch[j] * np.round(seen)
      rate[j] += ((reading - last[j]) / tick - rate[j]) * tick / (tick + drive.smooth[j])
      last[j] = reading
      error = drive.notch[j] * np.round(goals[t, j] / drive.notch[j]) - reading
      if abs(error) < drive.dead_band[j]:
        error = 0.0
      asked = drive.proportional[j] * error - drive.derivative[j] * rate[j]
      duty[j] = min(max(asked, -drive.most[j]), drive.most[j])
      duty[j] *= max(1.0 - drive.foldback[j] * rise[j], 0.1)
      rows[t, j, READING], rows[t, j, CURRENT] = reading, current[j]
      rows[t, j, DUTY], rows[t, j, VOLTAGE] = duty[j], volts
      rows[t, j, LINK], rows[t, j, SPEED] = q[j], v[j]
    for k in range(per_tick):
      time = max((t * per_tick + k) * STEP - lead, 0.0)
      drawn = 0.0
      for j in range(n):
        drawn += duty[j] * current[j]
      volts = supply.voltage * (1.0 - supply.fade * time) - supply.resistance * drawn
      for j in range(n):
        steady = (duty[j] * volts - drive.constant[j] * spin[j]) / drive.resistance[j]
        current[j] += (steady - current[j]) * STEP / max(drive.lag[j], STEP)
        torque = drive.constant[j] * current[j]
        if time > 0.0:
          rise[j] += STEP * (drive.heating[j] * torque**2 - rise[j] / drive.cooling[j])
        twist = rotor[j] - q[j] - slipped[j]
        passed = gears.teeth(twist, spin[j] - v[j], gear.gap[j], gear.stiffness[j], gear.damping[j])
        if abs(passed) > gear.slip[j]:
          limit = np.sign(passed) * gear.slip[j]
          slipped[j] += (passed - limit) / gear.stiffness[j]
          passed = limit
        sliding = gears.level(gear, j, rotor[j], spin[j], passed, time)
        bent = gears.bend(z[j], spin[j], sliding, stiff[j], STEP)
        rubbing = stiff[j] * bent + soft[j] * (bent - z[j]) / STEP
        z[j] = bent
        torque -= rubbing + gear.viscous[j] * spin[j] + passed
        if gear.ripple[j] != 0.0:
          torque += gear.ripple[j] * np.sin(gear.ripples[j] * rotor[j] + gear.ripple_phase[j])
        pushed[j] = torque
        link[j] = passed + gears.pulled(gear, j, q[j], v[j], bundle[j])
        if gear.cable[j] > 0.0:
          bundle[j] += STEP * gears.yielding(bundle[j], v[j], gear.cable_reach[j])
        if gear.loose[j] > 0.0:
          hard = _LOOSE_STIFFNESS * gear.loose[j]
          knock = gears.teeth(
            loose[j] - q[j], loose_speed[j] - v[j], gear.loose_gap[j], hard, 2e-3 * hard
          )
          link[j] += knock
          loose_speed[j] -= STEP * knock / gear.loose[j]
          loose[j] += STEP * loose_speed[j]
      bodies.accelerate(body, q, v, link, acceleration)
      for j in range(n):
        spin[j] += STEP * pushed[j] / drive.rotor[j]
        rotor[j] += STEP * spin[j]
        v[j] += STEP * acceleration[j]
        q[j] += STEP * v[j]
  return rows
