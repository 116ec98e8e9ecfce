"""The plant: servos with gear trains, friction and integer firmware on a tree of rigid bodies.

A servo is two masses: the motor (with the gear train, seen from the output) and the output stage
on the link, joined by a stiff gear with play. Friction is LuGre (Canudas de Wit et al. 1995) with a
bristle that yields after `presliding`. Every millisecond the firmware counts the encoder and sets
the duty in whole counts of the PWM; it uses nothing of `Servo` but its own constants.
Semi-implicit Euler with the speed-dependent terms implicit; bristles in closed form. J joints.
"""

from typing import NamedTuple

import numba
import numpy as np

from .rigid_body import Tree, dynamics, make_work, solve

COUNTS_PER_RADIAN = 4096 / (2 * np.pi)
"""12-bit encoder on the output (XM430 data sheet)."""
FULL_DUTY = 885
"""PWM counts of full duty (XM430 control table)."""
REGISTER_ONE = 128
"""The proportional register's divisor: duty count = error count * register / 128 (same place)."""
NEVER = 1e9
"""A place, angle or time that is not reached."""


class Servo(NamedTuple):
  """Constants of the servos, each [J]; those of effects are zero (or never) on a healthy one."""

  motor_inertia: np.ndarray  # kg m^2, seen from the output
  output_inertia: np.ndarray  # kg m^2, last gear stage
  viscous: np.ndarray  # N m s/rad, back-EMF included
  coulomb: np.ndarray  # N m
  breakaway: np.ndarray  # N m above coulomb, at rest
  stribeck_velocity: np.ndarray  # rad/s
  load: np.ndarray  # friction per torque
  load_of_motor: np.ndarray  # 1: that torque is the motor's, 0: the one through the gear
  positive: np.ndarray  # N m, more friction while turning forward
  negative: np.ndarray  # N m, more friction while turning backward
  quadratic: np.ndarray  # N m s^2/rad^2
  presliding: np.ndarray  # rad
  gear_stiffness: np.ndarray  # N m/rad
  gear_damping: np.ndarray  # N m s/rad
  gap: np.ndarray  # rad, full width of the play
  cogging_amplitude: np.ndarray  # N m
  cogging_periods: np.ndarray  # 1/rad
  cogging_phase: np.ndarray  # rad
  spring_stiffness: np.ndarray  # N m/rad
  spring_reference: np.ndarray  # rad
  stall: np.ndarray  # N m at full duty and nominal supply
  electrical_lag: np.ndarray  # s
  heating: np.ndarray  # K/(s N^2 m^2)
  cooling_time: np.ndarray  # s
  derating: np.ndarray  # 1/K
  register: np.ndarray  # proportional register of the firmware
  duty_limit: np.ndarray  # PWM counts
  encoder_offset: np.ndarray  # rad
  encoder_on_motor: np.ndarray  # 0 or 1
  eccentricity: np.ndarray  # rad, once a turn
  eccentricity_phase: np.ndarray  # rad
  latency: np.ndarray  # s from the command's arrival to the goal register
  # What no library of effects has.
  stick_depth: np.ndarray  # N m of friction at one spot
  stick_center: np.ndarray  # rad
  stick_width: np.ndarray  # rad
  rubber_stiffness: np.ndarray  # N m/rad of a Maxwell element beside the joint
  rubber_time: np.ndarray  # s
  flexible_inertia: np.ndarray  # kg m^2 on a spring on the link
  flexible_rate: np.ndarray  # rad/s, its natural frequency
  flexible_damping: np.ndarray  # damping ratio
  varying_stiffness: np.ndarray  # N m/rad, swelling and fading with time
  varying_period: np.ndarray  # s
  varying_reference: np.ndarray  # rad
  detent_torque: np.ndarray  # N m at the flanks of a magnetic detent
  detent_center: np.ndarray  # rad
  detent_width: np.ndarray  # rad
  stop_stiffness: np.ndarray  # N m/rad beyond a soft stop
  stop_angle: np.ndarray  # rad
  stop_side: np.ndarray  # +1: stops forward motion, -1: backward
  growing_friction: np.ndarray  # N m/s
  disturbance: np.ndarray  # N m of a sine from outside
  disturbance_rate: np.ndarray  # rad/s
  weak_side: np.ndarray  # share lost of torque in one direction
  dead_band: np.ndarray  # encoder counts of error that the firmware ignores


class World(NamedTuple):
  """What all joints share."""

  gravity: np.ndarray  # [3] m/s^2
  volts: float  # nominal supply
  droop: float  # 1/(N m), share of supply lost per total torque
  fade: float  # 1/s, share of supply lost per second
  counts_per_radian: float
  full_duty: int
  ticks_per_second: int  # of the firmware


class Trace(NamedTuple):
  """The servos' tables at each firmware tick, T ticks from `start` on."""

  position: np.ndarray  # [T, J] encoder counts
  velocity: np.ndarray  # [T, J] rad/s of the encoder's side
  effort: np.ndarray  # [T, J] N m of the motor before its own losses
  duty: np.ndarray  # [T, J] -1 to 1
  temperature_rise: np.ndarray  # [T, J] K
  volts: np.ndarray  # [T]


def make_servos(count: int, **constants: np.ndarray | float) -> Servo:
  """Returns servos with the given constants; all others as on a perfect machine."""
  defaults = {
    "stribeck_velocity": 0.1,
    "presliding": 3e-4,
    "gear_stiffness": 1000.0,
    "gear_damping": 0.4,
    "electrical_lag": 0.0,
    "cooling_time": 300.0,
    "duty_limit": FULL_DUTY,
    "stick_width": 1.0,
    "rubber_time": 1.0,
    "flexible_rate": 1.0,
    "varying_period": 1.0,
    "detent_width": 1.0,
    "stop_angle": NEVER,
    "stop_side": 1.0,
  }
  values = {**dict.fromkeys(Servo._fields, 0.0), **defaults, **constants}
  arrays = {name: np.asarray(value, float) for name, value in values.items()}
  return Servo(**{name: np.broadcast_to(a, (count,)).copy() for name, a in arrays.items()})


def simulate(
  tree: Tree,
  servo: Servo,
  *,
  world: World,
  start_angles: np.ndarray,
  arrivals: np.ndarray,
  commands: np.ndarray,
  start: float,
  ticks: int,
  step: float,
  encoder_noise: np.ndarray,
  dropouts: np.ndarray | None = None,
) -> Trace:
  """Returns what the servos' tables hold at each tick.

  Args:
    tree: the bodies, payloads attached.
    servo: constants of the servos.
    world: gravity, supply, resolution.
    start_angles: [J] rad, at rest.
    arrivals: [N] s at which commands reach the bus, increasing.
    commands: [N, J] rad.
    start: s, time of the first tick; before 0 the machine settles and neither warms nor drains.
    ticks: number of firmware ticks.
    step: s, of the integrator; a whole number of them makes a tick.
    encoder_noise: [ticks, J] counts, added before rounding.
    dropouts: [M, 3] rows (joint, from, to) [s] in which a motor gives nothing.
  """
  count = len(start_angles)
  table = np.zeros((5, ticks, count))
  trace = Trace(table[0], table[1], table[2], table[3], table[4], np.zeros(ticks))
  substeps = round(1 / (world.ticks_per_second * step))
  if dropouts is None:
    dropouts = np.zeros((0, 3))
  _run(
    tree,
    servo,
    world,
    make_work(count),
    start_angles.astype(float),
    arrivals,
    commands,
    start,
    1.0 / world.ticks_per_second,
    substeps,
    encoder_noise,
    dropouts,
    trace,
  )
  return trace


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _friction_level(servo, j, v, gear_torque, motor_torque, q, time):
  """Returns the dry friction [N m] that fully yielded bristles give, and its bias by direction."""
  ratio = v / servo.stribeck_velocity[j]
  level = servo.coulomb[j] + servo.breakaway[j] * np.exp(-ratio * ratio)
  level += servo.load[j] * abs(motor_torque if servo.load_of_motor[j] > 0.5 else gear_torque)
  level += servo.positive[j] if v > 0 else servo.negative[j]
  if servo.stick_depth[j] != 0.0:
    place = (q - servo.stick_center[j]) / servo.stick_width[j]
    level += servo.stick_depth[j] * np.exp(-place * place)
  if time > 0:
    level += servo.growing_friction[j] * time
  return level


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _link_torque(servo, j, q, time, rubber):
  """Returns the torque [N m] on the link of springs, detents, stops and outsiders."""
  torque = -servo.spring_stiffness[j] * (q - servo.spring_reference[j])
  if servo.rubber_stiffness[j] != 0.0:
    torque -= servo.rubber_stiffness[j] * (q - rubber)
  if servo.varying_stiffness[j] != 0.0:
    share = 0.5 - 0.5 * np.cos(2 * np.pi * time / servo.varying_period[j])
    torque -= servo.varying_stiffness[j] * share * (q - servo.varying_reference[j])
  if servo.detent_torque[j] != 0.0:
    place = (q - servo.detent_center[j]) / servo.detent_width[j]
    torque -= servo.detent_torque[j] * place * np.exp(0.5 - 0.5 * place * place)
  beyond = servo.stop_side[j] * (q - servo.stop_angle[j])
  if beyond > 0:
    torque -= servo.stop_side[j] * servo.stop_stiffness[j] * beyond
  if servo.disturbance[j] != 0.0 and time > 0:
    torque += servo.disturbance[j] * np.sin(servo.disturbance_rate[j] * time)
  return torque


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _duty_count(servo, world, j, goal, reading):
  """Returns the firmware's whole PWM count for a goal and a reading in encoder counts."""
  error = goal - reading
  if abs(error) <= servo.dead_band[j]:
    return 0.0
  # The register's arithmetic truncates towards zero.
  duty = float(int(error * servo.register[j] / REGISTER_ONE))
  return min(max(duty, -servo.duty_limit[j]), servo.duty_limit[j])


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _run(
  tree,
  servo,
  world,
  work,
  start_angles,
  arrivals,
  commands,
  start,
  tick,
  substeps,
  noise,
  dropouts,
  trace,
):
  count = len(start_angles)
  ticks = len(trace.volts)
  dt = tick / substeps
  q, qd = start_angles.copy(), np.zeros(count)
  motor, motor_speed = start_angles.copy(), np.zeros(count)
  bristle, rise, drive, duty = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
  rubber, flexible, flexible_speed = q.copy(), q.copy(), np.zeros(count)
  received = np.zeros(count, np.int64)
  right = np.zeros(count)
  supply = 1.0
  for index in range(ticks):
    now = start + index * tick
    for j in range(count):
      while received[j] + 1 < len(arrivals) and arrivals[received[j] + 1] + servo.latency[j] <= now:
        received[j] += 1
      on_motor = servo.encoder_on_motor[j] > 0.5
      angle = motor[j] if on_motor else q[j]
      angle += servo.encoder_offset[j]
      angle += servo.eccentricity[j] * np.sin(angle + servo.eccentricity_phase[j])
      reading = np.floor(angle * world.counts_per_radian + noise[index, j] + 0.5)
      goal = np.floor(commands[received[j], j] * world.counts_per_radian + 0.5)
      duty[j] = _duty_count(servo, world, j, goal, reading) / world.full_duty
      for m in range(len(dropouts)):
        if int(dropouts[m, 0]) == j and dropouts[m, 1] <= now < dropouts[m, 2]:
          duty[j] = 0.0
      trace.position[index, j] = reading
      trace.velocity[index, j] = motor_speed[j] if on_motor else qd[j]
      trace.effort[index, j] = drive[j]
      trace.duty[index, j] = duty[j]
      trace.temperature_rise[index, j] = rise[j]
    trace.volts[index] = supply * world.volts
    for sub in range(substeps):
      time = now + sub * dt
      dynamics(tree, q, qd, world.gravity, work)
      load = 0.0
      for j in range(count):
        load += abs(drive[j])
      supply = 1.0
      if time > 0:
        supply = max(1.0 - world.droop * load - world.fade * time, 0.1)
      for j in range(count):
        strength = supply * max(1.0 - servo.derating[j] * rise[j], 0.1)
        target = duty[j] * servo.stall[j] * strength
        if duty[j] < 0:
          target *= 1.0 - servo.weak_side[j]
        if servo.electrical_lag[j] > 0:
          drive[j] += (target - drive[j]) * (1 - np.exp(-dt / servo.electrical_lag[j]))
        else:
          drive[j] = target
        if time > 0 and servo.heating[j] > 0:
          rise[j] += dt * (servo.heating[j] * drive[j] ** 2 - rise[j] / servo.cooling_time[j])
        # The gear: contact at either end of the gap pushes and never pulls.
        apart = motor[j] - q[j]
        half = 0.5 * servo.gap[j]
        gear = 0.0
        if apart > half:
          gear = max(
            servo.gear_stiffness[j] * (apart - half)
            + servo.gear_damping[j] * (motor_speed[j] - qd[j]),
            0.0,
          )
        elif apart < -half:
          gear = min(
            servo.gear_stiffness[j] * (apart + half)
            + servo.gear_damping[j] * (motor_speed[j] - qd[j]),
            0.0,
          )
        # LuGre on the motor's side; the bristle's own equation is solved over the step.
        v = motor_speed[j]
        level = _friction_level(servo, j, v, gear, drive[j], q[j], time)
        before = bristle[j]
        direction = 1.0 if v > 0 else -1.0
        bristle[j] = direction + (before - direction) * np.exp(-abs(v) * dt / servo.presliding[j])
        micro = np.sqrt(level * servo.presliding[j] * servo.motor_inertia[j])
        friction = level * bristle[j] + micro * (bristle[j] - before) / dt
        cogging = servo.cogging_amplitude[j] * np.sin(
          servo.cogging_periods[j] * q[j] + servo.cogging_phase[j]
        )
        free = v + dt / servo.motor_inertia[j] * (drive[j] - friction - gear)
        resist = servo.viscous[j] + servo.quadratic[j] * abs(v)
        motor_speed[j] = free / (1.0 + dt / servo.motor_inertia[j] * resist)
        torque = gear + cogging + _link_torque(servo, j, q[j], time, rubber[j])
        rubber[j] += (q[j] - rubber[j]) * (1 - np.exp(-dt / servo.rubber_time[j]))
        if servo.flexible_inertia[j] > 0:
          rate = servo.flexible_rate[j]
          pull = rate * rate * (q[j] - flexible[j])
          pull += 2 * servo.flexible_damping[j] * rate * (qd[j] - flexible_speed[j])
          torque -= servo.flexible_inertia[j] * pull
          flexible_speed[j] += dt * pull
          flexible[j] += dt * flexible_speed[j]
        right[j] = torque - work.bias[j]
      for j in range(count):
        work.matrix[j, j] += servo.output_inertia[j]
      solve(tree.parent, work.matrix, right)  # right becomes the acceleration
      for j in range(count):
        qd[j] += dt * right[j]
        q[j] += dt * qd[j]
        motor[j] += dt * motor_speed[j]
