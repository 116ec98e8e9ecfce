"""Drives, motors, transmissions and links together, 50 us a step, by semi-implicit Euler.

A joint is a rotor (at the joint's side of its ratio) that drives its link through a spring. The
drive closes position on the link's encoder and speed on the motor's:
  v* = Kp (goal - reading), limited in size and slope;
  I' = (v* - w) / Ti - I / leak;  torque = Kv (v* - w + I), limited; the current follows as a lag.

Compiled anew in every process: a compiler's cache would not see changes of the laws in other files.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from benchmarks.drive_axes import friction, mechanics

Array = np.ndarray
STEP = 50e-6  # s
READING, SPEED, CURRENT, LINK, LINK_SPEED, ROTOR, ROTOR_SPEED, FULL = range(8)
"""Columns of a tick: encoder, motor's speed as the drive has it, torque by the current, true
positions and speeds, 1 where the torque is limited."""


class Axes(NamedTuple):
  """Constants of the joints, each [n], in SI units of the joint: rad and N m, or m and N."""

  # Drive.
  position_gain: Array  # 1/s
  speed_gain: Array  # N m s/rad
  integral_time: Array  # s
  leak: Array  # s, in which the integral forgets
  most_speed: Array  # rad/s
  most_slope: Array  # rad/s^2
  limit: Array  # N m
  filter_time: Array  # s, of the motor's speed
  encoder_step: Array  # rad
  encoder_noise: Array  # rad
  # Motor.
  lag: Array  # s, of the current
  gain: Array  # torque over the current's as printed
  rotor: Array  # kg m^2
  # Friction, on the rotor.
  viscous: Array  # N m s/rad
  dry: Array  # N m, in motion
  breakaway: Array  # N m, beyond it at rest
  fall: Array  # rad/s, in which it falls
  presliding: Array  # rad
  of_load: Array  # dry friction per torque of the transmission
  # Transmission.
  stiffness: Array  # N m/rad
  damping: Array  # N m s/rad
  half_play: Array  # rad
  error: Array  # rad, of the transmission, periodic
  error_waves: Array  # 1/rad
  # What effects add.
  more_dry: Array  # N m
  more_breakaway: Array  # N m
  more_fall: Array  # rad/s
  offset: Array  # N m, constant torque on the rotor
  drag: Array  # N m s^2/rad^2
  cogging: Array  # N m
  cogging_waves: Array  # 1/rad
  cogging_phase: Array  # rad
  spring: Array  # N m/rad, at the link
  spring_at: Array  # rad
  # What no library names.
  smoothing: Array  # s, of goals
  cold: Array  # N m s/rad, viscous friction that goes as the grease warms
  warming: Array  # s
  spot: Array  # N m, dry friction about a place
  spot_at: Array  # rad
  spot_width: Array  # rad
  slips_at: Array  # N m, of a belt
  cable: Array  # N m/rad, beyond an angle
  cable_at: Array  # rad
  brake: Array  # N m, while it drags
  brake_period: Array  # s
  slosh: Array  # kg m^2, hung on the link by a spring
  slosh_rate: Array  # rad/s, its natural frequency
  slosh_damping: Array  # share of critical


@numba.njit
def simulate(
  axes: Axes, of: mechanics.Coefficients, goals: Array, noise: Array, per_tick: int, lead: float
) -> Array:
  """Returns what axes do that start at rest at their first goals, [T, n, 8].

  Args:
    axes: constants.
    of: the links' coefficients.
    goals: at the drive's ticks [T, n].
    noise: of the encoders, standard normal [T, n].
    per_tick: steps from one tick to the next.
    lead: s before the log's zero, at which grease is cold and brakes start their periods.
  """
  ticks, n = goals.shape
  rows = np.empty((ticks, n, 8))
  q, th, goal = goals[0].copy(), goals[0].copy(), goals[0].copy()
  v, w, acc, torque = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
  seen, asked, integral = np.zeros(n), np.zeros(n), np.zeros(n)
  current, wanted, slipped = np.zeros(n), np.zeros(n), np.zeros(n)
  hung, hung_speed = q.copy(), np.zeros(n)
  elements = np.zeros((n, friction.SHARES.size))
  period = per_tick * STEP
  last = th.copy()
  for tick in range(ticks):
    time = tick * period - lead
    for j in range(n):
      rough = q[j] + axes.encoder_noise[j] * noise[tick, j]
      reading = axes.encoder_step[j] * round(rough / axes.encoder_step[j])
      share = period / (axes.filter_time[j] + period)
      seen[j] += share * ((th[j] - last[j]) / period - seen[j])
      last[j] = th[j]
      goal[j] += (goals[tick, j] - goal[j]) * period / (axes.smoothing[j] + period)
      asks = axes.position_gain[j] * (goal[j] - reading)
      asks = min(max(asks, -axes.most_speed[j]), axes.most_speed[j])
      slope = axes.most_slope[j] * period
      asked[j] = min(max(asks, asked[j] - slope), asked[j] + slope)
      behind = asked[j] - seen[j]
      raw = axes.speed_gain[j] * (behind + integral[j])
      current[j] = min(max(raw, -axes.limit[j]), axes.limit[j])
      if raw == current[j] or raw * behind < 0.0:  # no wind-up
        integral[j] += period * (behind / axes.integral_time[j] - integral[j] / axes.leak[j])
      row = rows[tick, j]
      row[READING], row[SPEED], row[CURRENT] = reading, seen[j], wanted[j]
      row[LINK], row[LINK_SPEED], row[ROTOR], row[ROTOR_SPEED] = q[j], v[j], th[j], w[j]
      row[FULL] = 0.0 if raw == current[j] else 1.0
    for _ in range(per_tick):
      time += STEP
      for j in range(n):
        wanted[j] += (current[j] - wanted[j]) * STEP / axes.lag[j]
        wave = axes.error_waves[j]
        twist = th[j] + axes.error[j] * math.sin(wave * th[j]) - q[j] - slipped[j]
        passed = _teeth(twist, w[j] - v[j], axes.stiffness[j], axes.damping[j], axes.half_play[j])
        if abs(passed) > axes.slips_at[j]:
          kept = math.copysign(axes.slips_at[j], passed)
          slipped[j] += twist - kept / axes.stiffness[j]
          passed = kept
        rubs = axes.dry[j] + axes.more_dry[j] + axes.of_load[j] * abs(passed)
        rubs += friction.stribeck(w[j], axes.breakaway[j], axes.fall[j])
        rubs += friction.stribeck(w[j], axes.more_breakaway[j], axes.more_fall[j])
        rubs += friction.stribeck(q[j] - axes.spot_at[j], axes.spot[j], axes.spot_width[j])
        if math.sin(math.tau * time / axes.brake_period[j]) > 0.3:
          rubs += axes.brake[j]
        dry = friction.slip(elements[j], w[j] * STEP, axes.dry[j], axes.presliding[j], rubs)
        viscous = axes.viscous[j]
        if axes.cold[j] > 0.0:
          viscous += axes.cold[j] * math.exp(-max(time, 0.0) / axes.warming[j])
        back = passed * (1.0 + axes.error[j] * wave * math.cos(wave * th[j]))
        push = axes.gain[j] * wanted[j] - dry - (viscous + axes.drag[j] * abs(w[j])) * w[j]
        push += axes.offset[j] - back
        push += axes.cogging[j] * math.sin(axes.cogging_waves[j] * q[j] + axes.cogging_phase[j])
        w[j] += STEP * push / axes.rotor[j]
        torque[j] = passed - axes.spring[j] * (q[j] - axes.spring_at[j])
        torque[j] -= axes.cable[j] * max(q[j] - axes.cable_at[j], 0.0)
        if axes.slosh[j] > 0.0:
          rate = axes.slosh_rate[j]
          pull = rate * rate * (hung[j] - q[j])
          pull += 2.0 * axes.slosh_damping[j] * rate * (hung_speed[j] - v[j])
          torque[j] += axes.slosh[j] * pull
          hung_speed[j] -= STEP * pull
          hung[j] += STEP * hung_speed[j]
      mechanics.accelerate(of, q, v, torque, acc)
      for j in range(n):
        v[j] += STEP * acc[j]
        q[j] += STEP * v[j]
        th[j] += STEP * w[j]
  return rows


@numba.njit(cache=True)
def _teeth(twist: float, rate: float, stiffness: float, damping: float, half: float) -> float:
  """Returns the torque through a transmission: a spring with a damper, none within its play."""
  if half == 0.0:
    return stiffness * twist + damping * rate
  if abs(twist) <= half:
    return 0.0
  if twist > 0.0:
    return max(stiffness * (twist - half) + damping * rate, 0.0)
  return min(stiffness * (twist + half) + damping * rate, 0.0)
