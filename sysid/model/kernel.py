"""One joint's motion, compiled: what MuJoCo and `suite.effects` do to it, a thousand times faster.

Naming an effect takes tens of thousands of roll-outs. Stepping `suite.effects.EffectStack` from
Python costs about 10 us a step, this kernel 20 ns. It is the same physics for one hinge or slide
joint whose surroundings are prescribed (`reduction`); a test compares the two for every kind.
Whatever is reported at the end is simulated by MuJoCo itself.

    (I(t) + armature) dv/dt = torque - damping v - drag |v| v - k (q - q_ref) - gravity(t, q) - c(t)
                              - friction

The scheme is MuJoCo's `implicitfast`: forces at the old position, damping implicit, then the new
speed moves the position. Of a model that Euler's scheme integrates the joint's damping alone is
implicit, the servo's is not, as there. A scheme of higher order would be nearer to the machine, but
constants that are fitted with it would not fit MuJoCo. Dry friction is MuJoCo's constraint, solved
in closed form for its one row: f = -(a_free + b v) / (1/m + R), at most F.

Shapes: C commands, S samples, T grid points, W windows.
"""

import math
from pathlib import Path
from typing import Any

import numba
import numpy as np

from nerf2real.suite.effects.kinds import gear_train, laws
from nerf2real.suite.effects.kinds.backlash import LINK_SHARE, ROTOR_WITHOUT_ARMATURE
from nerf2real.sysid.model.kernel_cache import discard_stale

Array = np.ndarray

NAMES = (
  # the actuator: torque = clip(input u + constant + position q + velocity v), all with the gear in
  *("input", "constant", "position", "velocity", "lowest", "highest"),
  # the joint
  *("armature", "damping", "friction", "drag", "stiffness", "reference"),
  # what effects add
  *("gain", "command_delay", "measurement_delay", "effort_delay", "clock_rate"),
  *("breakaway", "stribeck_velocity", "load_coefficient", "offset_force"),
  *("gap", "encoder_on_motor", "encoder_offset"),
  *("droop", "fade", "heating", "time_constant", "derating"),
  *("amplitude", "periods", "phase"),
  # a choice between models: which torque loads the gear
  *("load_kind",),
  # MuJoCo's friction constraint: R of its row, and the rate at which it takes speed away
  *("softness", "stopping_rate"),
  # of heat: whether the actuator saturates earlier too, whether its measured effort tells, and
  # whether the joint's damping, a motor's back-EMF, takes from the current that heats
  *("heat_scales_limit", "heat_tells", "heat_back_emf"),
  # load friction: its square, and how much larger it is at rest
  *("load_square", "load_at_rest", "load_velocity"),
  # where the teeth of a gear with play meet
  *("tooth_stiffness", "tooth_damping", "friction_on_link"),
  # how far the state follows the readings: share of a difference, and speed per difference
  *("follow", "follow_speed"),
  # the same of the supply as of heat, whose load is then duty times current, or the current
  *("sag_scales_limit", "sag_tells", "sag_back_emf", "sag_pulsed"),
  # torque at a duty over the declared: nothing here needs it, what is told of the duty does
  "strength",
  # s by which the other joints' readings, which prescribe the surroundings, are late
  "surroundings_delay",
  # whether the servo's damping acts at the speed before the step: Euler, MuJoCo's default
  "servo_explicit",
  # by which contacts bend under the joint's dry friction before they slide; 0: rigid
  "presliding",
)
INDEX = {name: index for index, name in enumerate(NAMES)}
_RECORD = np.dtype([(name, np.float64) for name in NAMES])

NEUTRAL = {
  "heat_tells": 1.0,
  "sag_tells": 1.0,
  "gain": 1.0,
  "strength": 1.0,
  "stribeck_velocity": 0.1,
  "load_velocity": 0.1,
  "time_constant": 300.0,
  "derating": 0.004,
  "tooth_stiffness": 1000.0,
  "tooth_damping": 0.4,
}
"""Values that do nothing, where that is not zero."""

_LITTLE = 0.03  # rad; beyond it series of three terms are no longer exact to rounding
_CACHE = discard_stale(
  Path(__file__).parent, ("kernel",), (Path(gear_train.__file__), Path(laws.__file__))
)


@numba.njit(cache=_CACHE, nogil=True, fastmath=False, error_model="numpy")
def _cubic(x: float, a: float, b: float, c: float, d: float) -> float:
  """Returns the value x of the way from b to c on a cubic through four neighbours (Catmull-Rom)."""
  bend = 2.0 * a - 5.0 * b + 4.0 * c - d + x * (3.0 * (b - c) + d - a)
  return b + 0.5 * x * (c - a + x * bend)


@numba.njit(cache=_CACHE, nogil=True, fastmath=False, error_model="numpy")
def force_at(q: float, v: float, weights: Array, bounds: Array) -> float:
  """Returns the force of a table with a margin of one place around its bounds, bicubic between.

  Args:
    q: position.
    v: velocity.
    weights: [P, V] forces.
    bounds: [4] position low, high, velocity low, high; beyond them the value at the end is taken.
  """
  nq, nv = weights.shape
  pq = (q - bounds[0]) * (nq - 3) / (bounds[1] - bounds[0])
  pv = (v - bounds[2]) * (nv - 3) / (bounds[3] - bounds[2])
  pq = min(max(pq, 0.0), nq - 3.0)
  pv = min(max(pv, 0.0), nv - 3.0)
  i, j = min(int(pq), nq - 4), min(int(pv), nv - 4)
  x, y = pq - i, pv - j
  w = weights
  return _cubic(
    x,
    _cubic(y, w[i, j], w[i, j + 1], w[i, j + 2], w[i, j + 3]),
    _cubic(y, w[i + 1, j], w[i + 1, j + 1], w[i + 1, j + 2], w[i + 1, j + 3]),
    _cubic(y, w[i + 2, j], w[i + 2, j + 1], w[i + 2, j + 2], w[i + 2, j + 3]),
    _cubic(y, w[i + 3, j], w[i + 3, j + 1], w[i + 3, j + 2], w[i + 3, j + 3]),
  )


@numba.njit(cache=_CACHE, nogil=True, fastmath=False, error_model="numpy")
def _turned(cosine: float, sine: float, angle: float, by: float) -> tuple[float, float]:
  """Returns cosine and sine of an angle that has turned by a little since those that are given."""
  if abs(by) > _LITTLE:
    return math.cos(angle), math.sin(angle)
  square = by * by
  fourth = square * square
  s = by + by * square * ((square / 120.0 - 1.0 / 6.0) - fourth / 5040.0)
  less = square * ((0.5 - square / 24.0) + fourth / 720.0)  # 1 - cosine
  return cosine - (cosine * less + sine * s), sine - (sine * less - cosine * s)


def record(p: Array) -> np.void:
  """Returns parameters [P] as what the kernel reads by name, without a copy where it can."""
  return np.ascontiguousarray(p, np.float64).view(_RECORD)[0]


def table_force(q: Array, v: Array, weights: Array, bounds: Array) -> Array:
  """Returns the force [N] of a table at positions and velocities [N]."""
  return np.array([force_at(a, b, weights, bounds) for a, b in zip(q, v, strict=True)])


@numba.njit(cache=_CACHE, nogil=True, fastmath=False, error_model="numpy")
def simulate(
  p: Any,
  step: float,
  command_time: Array,
  command: Array,
  sample_time: Array,
  inertia: Array,
  gravity_cos: Array,
  gravity_sin: Array,
  bias: Array,
  load: Array,
  hinge: bool,
  window_start: Array,
  window_position: Array,
  window_velocity: Array,
  reading: Array,
  weights: Array,
  bounds: Array,
  out_position: Array,
  out_velocity: Array,
  out_torque: Array,
) -> None:
  """Simulates one log and writes position, velocity and actuator torque at the samples [S].

  Args:
    p: parameters, as `record` gives them.
    step: s between grid points, which start at time 0.
    command_time: [C] s, increasing.
    command: [C] held until the next.
    sample_time: [S] s, stamps of the samples, increasing.
    inertia: [T] kg m^2 without armature.
    gravity_cos: [T] gravity's torque (to be overcome) at position 0, N m; a slide's everywhere, N.
    gravity_sin: [T] the same a quarter turn further (hinge).
    bias: [T] what the other joints' motion demands, N m.
    load: [T] sum of the other actuators' |torque|, N m.
    hinge: whether gravity turns with the joint.
    window_start: [W] indices of the samples at which the state is set anew; the first is 0.
    window_position: [W].
    window_velocity: [W].
    reading: [S] measured positions, which the state follows where it is told to; NaN for none.
    weights: [P, V] table of a learned force, empty for none.
    bounds: [4] its position low, high, velocity low, high.
    out_position: [S], written.
    out_velocity: [S], written.
    out_torque: [S], written.
  """
  slope, constant, per_q, per_v = p.input, p.constant, p.position, p.velocity
  lowest, highest = p.lowest, p.highest
  armature, damping, friction, drag = p.armature, p.damping, p.friction, p.drag
  stiffness, reference = p.stiffness, p.reference
  gain, delay, rate = p.gain, p.command_delay, p.clock_rate
  late, late_effort, others_late = p.measurement_delay, p.effort_delay, p.surroundings_delay
  breakaway, stribeck, offset_force = p.breakaway, p.stribeck_velocity, p.offset_force
  half, on_motor, encoder = 0.5 * p.gap, p.encoder_on_motor, p.encoder_offset
  droop, fade, heating, derating = p.droop, p.fade, p.heating, p.derating
  amplitude, periods, phase = p.amplitude, p.periods, p.phase
  softness, stopping_rate = p.softness, p.stopping_rate
  heat_limits, heat_tells = p.heat_scales_limit > 0.5, p.heat_tells > 0.5
  heat_damping = damping if p.heat_back_emf > 0.5 else 0.0
  load_kind, load_share, load_square = p.load_kind, p.load_coefficient, p.load_square
  load_at_rest, load_velocity = p.load_at_rest, p.load_velocity
  tooth_stiffness, tooth_damping = p.tooth_stiffness, p.tooth_damping
  friction_on_link, explicit = p.friction_on_link, p.servo_explicit > 0.5
  bends = p.presliding if friction > 0.0 else 0.0
  follow, follow_speed = p.follow, p.follow_speed
  sag_by_current, sag_pulsed = p.sag_back_emf > 0.5 and highest < math.inf, p.sag_pulsed > 0.5
  sag_limits, sag_tells = p.sag_scales_limit > 0.5, p.sag_tells > 0.5
  learned = weights.size > 0
  samples = sample_time.size
  windows = window_start.size
  last = inertia.size - 1
  rotor = armature * (1.0 - LINK_SHARE)
  keep_cool = 1.0 - step / max(p.time_constant, step)
  rate_of_steps, true_time = 1.0 / step, 1.0 / (1.0 + rate)
  stamped = (1.0 + rate) / step

  for w in range(windows):
    end = window_start[w + 1] if w + 1 < windows else samples
    s = window_start[w]
    e = s
    # True time of a sample: its stamp, less clock drift and latency.
    first = sample_time[s] * true_time - late
    n = math.floor(first / step)
    n = min(max(n, 0), last)
    first_n = n
    q = window_position[w] - encoder
    v = window_velocity[w]
    time = n * step
    if w > 0 or late == 0.0:
      q += v * (time - first)
    low_index, high_index = 0, command_time.size - 1
    while low_index < high_index:  # the last command not after the window's start
      middle = (low_index + high_index + 1) // 2
      if command_time[middle] <= time - delay:
        low_index = middle
      else:
        high_index = middle - 1
    pointer = low_index
    heat = 0.0
    supply = 1.0
    torque = 0.0
    acceleration = 0.0
    told = 0.0
    gap_offset = 0.0
    motor_speed = v
    bent, was = 0.0, 0.0
    passed = 0.0
    cosine, sine = math.cos(q), math.sin(q)
    link_freely = 0.0  # acceleration of a link by all but the gear, in the last step
    while s < end:
      when = sample_time[s] * true_time - late
      while s < end and when < time and n == 0:
        out_position[s] = q + encoder + on_motor * gap_offset
        out_velocity[s] = v
        s += 1
        if s < end:
          when = sample_time[s] * true_time - late
      if s >= end:
        break
      # The command during this step.
      reach = time - delay
      while pointer + 1 < command_time.size and command_time[pointer + 1] <= reach:
        pointer += 1
      u = command[pointer]
      later, share = u, 0.0
      if pointer + 1 < command_time.size and command_time[pointer + 1] < reach + step:
        share = (reach + step - command_time[pointer + 1]) * rate_of_steps
        later = command[pointer + 1]
      # The surroundings were measured: stamped time, late where all readings are.
      i = min(int((time + others_late) * stamped + 0.5), last)
      seen_v = motor_speed if half > 0.0 else v
      seen_q = q + encoder + on_motor * gap_offset
      before = torque  # of the last step
      inner, outer, untold = gain, 1.0, 1.0  # strength before the limits and after; not in efforts
      if heating > 0.0:
        heat = laws.warmed(heat, before - heat_damping * v, heating * step, keep_cool)
        weaker = laws.strength_of_heat(heat, derating)
        inner, outer = (inner, outer * weaker) if heat_limits else (inner * weaker, outer)
        untold *= 1.0 if heat_tells else weaker
      if droop > 0.0 or fade != 0.0:
        if sag_by_current:
          full = before / supply
          duty = np.sign(full) if sag_pulsed else full / highest
          weaker = laws.strength_of_source(
            duty * full, duty * damping * v, load[i], time, droop, fade
          )
        else:
          weaker = laws.strength_of_supply(abs(before) + load[i], time, droop, fade)
        supply = weaker
        inner, outer = (inner, outer * weaker) if sag_limits else (inner * weaker, outer)
        untold *= 1.0 if sag_tells else weaker
      strength = inner * outer
      rest = constant + per_q * seen_q + per_v * seen_v
      torque = outer * min(max(inner * (slope * u + rest), lowest), highest)
      if share > 0.0:  # limits first: a mean of commands would lose the moment of a large jump
        other = outer * min(max(inner * (slope * later + rest), lowest), highest)
        torque += share * (other - torque)
      told_before = told
      told = torque / untold
      # Torque between steps is interpolated: a jump would make errors jump with latencies.
      while e < end:
        x = (sample_time[e] * true_time - late_effort - time) * rate_of_steps + 1.0
        if x > 1.0:
          break
        out_torque[e] = told if n == 0 else told_before + max(x, 0.0) * (told - told_before)
        e += 1
      demand = gravity_cos[i]
      if hinge:
        demand = demand * cosine + gravity_sin[i] * sine
      passive = offset_force - bias[i] - stiffness * (q - reference)
      if amplitude != 0.0:
        passive += laws.cogging(q, amplitude, periods, phase)
      if learned:
        passive += force_at(q, v, weights, bounds)
      passive -= demand
      limit = friction
      if breakaway > 0.0:
        limit += laws.stribeck(v, breakaway, stribeck)
      if load_share > 0.0 or load_square > 0.0:
        taken = demand + bias[i] + inertia[i] * acceleration
        # Torque of the last step, as suite.effects.
        carried = laws.gear_load(load_kind, before, before - damping * v, taken)
        limit += laws.load_friction(
          carried, v, load_share, load_square, load_at_rest, load_velocity
        )
      back_emf = 0.0
      if outer * lowest < torque < outer * highest:
        back_emf = strength * per_v
      if half > 0.0:  # a motor of its own
        motor = rotor if rotor > 0.0 else ROTOR_WITHOUT_ARMATURE * inertia[i]
        link = inertia[i] + armature - min(rotor, armature)
        if n == first_n:
          gap_offset = half if torque >= 0.0 else -half
          was = q + gap_offset
        on_motor_side = (1.0 - friction_on_link) * limit
        turning = torque - back_emf * motor_speed
        if bends > 0.0 and on_motor_side > 0.0:
          of_constant = (1.0 - friction_on_link) * friction
          contact = laws.contact_stiffness(bends, of_constant, motor, step)
          bent = laws.bent_on(bent, q + gap_offset - was, contact, on_motor_side)
          was = q + gap_offset
          turning -= laws.presliding(bent, motor_speed, contact, on_motor_side, step)
          on_motor_side = 0.0
        gap_offset, motor_speed, passed = gear_train.advance(
          gap_offset,
          motor_speed,
          v,
          link_freely,
          turning,
          damping - back_emf,
          on_motor_side,
          motor,
          link,
          half,
          tooth_stiffness,
          tooth_damping,
          step,
        )
        mass, force, slowed, dry = link, passed + passive, 0.0, friction_on_link * limit
      else:
        mass, force, dry = inertia[i] + armature, torque + passive, limit
        slowed = damping
        if bends > 0.0:
          contact = laws.contact_stiffness(bends, friction, mass, step)
          bent = laws.bent_on(bent, q - was if n > first_n else 0.0, contact, limit)
          was = q
          force -= laws.presliding(bent, v, contact, limit, step)
          dry = 0.0
      # A step of velocity: the friction that stops it, then damping implicit.
      resist = slowed + drag * abs(v)
      slope_v = slowed + 2.0 * drag * abs(v)
      if half == 0.0 and not explicit:
        slope_v -= back_emf
      freely = 1.0 / mass
      yielding, pace = 1.0 / (freely + softness), step / (mass + step * slope_v)
      pushed = force - resist * v
      rubbed = (pushed * freely + stopping_rate * v) * yielding
      rubbed = min(max(rubbed, -dry), dry)
      speed = v + pace * (pushed - rubbed)
      acceleration = (speed - v) * rate_of_steps
      if half > 0.0:
        link_freely = acceleration - passed * freely
      moved = step * speed
      after = q + moved
      ahead = time + step
      apart = 0.0  # the last reading within the step, less what is simulated of it
      while s < end and when < ahead:
        x = max((when - time) * rate_of_steps, 0.0)
        out_position[s] = q + x * (after - q) + encoder + on_motor * gap_offset
        out_velocity[s] = v + x * (speed - v)
        if follow > 0.0 and not math.isnan(reading[s]):
          apart = reading[s] - out_position[s]
        s += 1
        if s < end:
          when = sample_time[s] * true_time - late
      moved += follow * apart
      was += follow * apart  # readings' noise bends no contact
      q += moved
      if hinge:
        cosine, sine = _turned(cosine, sine, q, moved)
      v = speed + follow_speed * apart
      time = ahead
      n += 1
    for index in range(e, end):
      out_torque[index] = told
