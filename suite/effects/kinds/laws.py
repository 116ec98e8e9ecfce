"""The laws of effects, compiled once, for all that simulates or balances a joint.

Each is a function of numbers that other compiled code may call (`stribeck`, as the analyser's
kernel does), and the same of arrays, element by element (`over(stribeck)`, as the operators do).
"""

import functools
import math
from collections.abc import Callable

import numba

LEAST_STRENGTH = 0.1
"""Of an actuator that is hot or starved; chosen: it has shut down, and the model stays regular."""
_SLOWEST = 1e-6  # rad/s, against division by zero
_GONE = 40.0  # exponent from which less than a rounding of 1 is left

law = numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
"""Compiles a law."""


@functools.cache
def over(function: Callable) -> Callable:
  """Returns a law as a function of arrays that broadcast."""
  return numba.vectorize(nopython=True, cache=True)(function.py_func)  # type: ignore[attr-defined]


@law
def stribeck(speed: float, breakaway: float, velocity: float) -> float:
  """Returns what dry friction has beyond that in motion: breakaway exp(-(speed / velocity)^2).

  Source: Armstrong-Helouvry, Dupont, Canudas de Wit 1994, general kinetic friction model with
  Stribeck exponent 2.
  """
  ratio = speed / max(velocity, _SLOWEST)
  square = ratio * ratio
  return breakaway * math.exp(-square) if square < _GONE else 0.0


@law
def contact_stiffness(reach: float, dry: float, inertia: float, step: float) -> float:
  """Returns the stiffness of contacts that bend by a reach under a dry friction, in series with
  what a step can hold: stable however stiff they are.

  Args:
    reach: rad, positive.
    dry: N m, positive.
    inertia: that they hold, kg m^2.
    step: s.
  """
  return 1.0 / (reach / dry + step * step / inertia)


@law
def bent_on(bent: float, moved: float, stiffness: float, dry: float) -> float:
  """Returns the deflection of contacts after a motion, which bend ever less as they slide: the law
  of Dahl 1968, d bent = (1 - sign(v) bent / most) d position, solved for a constant friction.

  MuJoCo has the same as the bristles of its `dcmotor`: a file can hold it.
  """
  most = dry / stiffness
  if moved == 0.0:
    return min(max(bent, -most), most)
  end = most if moved > 0.0 else -most
  return end + (bent - end) * math.exp(-abs(moved) / most)


@law
def presliding(bent: float, speed: float, stiffness: float, dry: float, step: float) -> float:
  """Returns the friction of contacts at the end of a step, by the speed [rad/s] before it."""
  return min(max(stiffness * (bent + step * speed), -dry), dry)


@law
def gear_load(carried: float, actuator: float, motor: float, link: float) -> float:
  """Returns the torque that loads a gear.

  Args:
    carried: which: 0 the actuator's, 1 the motor's, 2 the link's, 3 the larger of these two, 4
      their mean.
    actuator: torque of the actuator, N m.
    motor: the same less the joint's damping, N m.
    link: what the link takes, N m.
  """
  if carried < 0.5:
    return abs(actuator)
  if carried < 1.5:
    return abs(motor)
  if carried < 2.5:
    return abs(link)
  if carried < 3.5:
    return max(abs(motor), abs(link))
  return 0.5 * (abs(motor) + abs(link))


@law
def load_friction(
  load: float, speed: float, coefficient: float, quadratic: float, rest: float, velocity: float
) -> float:
  """Returns dry friction under a load: (coefficient load + quadratic load^2)
  (1 + rest exp(-(speed / velocity)^2)).

  Source: Duclusaud, Passault, Padois and Ly 2024.
  """
  rubbing = (coefficient + quadratic * load) * load
  if rest > 0.0:
    rubbing *= 1.0 + stribeck(speed, rest, velocity)
  return rubbing


@law
def cogging(position: float, amplitude: float, periods: float, phase: float) -> float:
  """Returns a torque that repeats with position: amplitude sin(periods position + phase)."""
  return amplitude * math.sin(periods * position + phase)


@law
def warmed(rise: float, torque: float, heating: float, kept: float) -> float:
  """Returns the rise of temperature after a step: rise kept + heating torque^2.

  Args:
    rise: K, before.
    torque: N m.
    heating: K/(N^2 m^2) in a step.
    kept: 1 - step / time constant.
  """
  return rise * kept + heating * torque * torque


@law
def strength_of_heat(rise: float, derating: float) -> float:
  """Returns the strength of an actuator that is warmer by a rise: 1 - derating rise."""
  return max(1.0 - derating * rise, LEAST_STRENGTH)


@law
def strength_of_supply(load: float, time: float, droop: float, fade: float) -> float:
  """Returns the strength of actuators under a supply: 1 - droop load - fade time.

  Args:
    load: sum of the actuators' |torque|, N m.
    time: s since the start.
    droop: 1/(N m).
    fade: 1/s.
  """
  return max(1.0 - droop * load - fade * time, LEAST_STRENGTH)


@law
def strength_of_source(
  drawn: float, spared: float, load: float, time: float, droop: float, fade: float
) -> float:
  """Returns the voltage of a source with a resistance, over that without load.

  Bridges draw duty times current in the mean, or the current while they are on (then the duty is 1
  or -1 here), and the current is the voltage's less what back-EMF takes:
  s = 1 - droop (s drawn - spared) - droop load - fade time, solved for s.

  Args:
    drawn: sum of duty times torque at the full voltage, N m.
    spared: sum of duty times the torque that back-EMF takes, N m.
    load: of others, N m.
    time: s since the start.
    droop: 1/(N m).
    fade: 1/s.
  """
  strength = (1.0 + droop * (spared - load) - fade * time) / (1.0 + droop * drawn)
  return max(strength, LEAST_STRENGTH)
