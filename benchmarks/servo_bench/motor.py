"""A brushed DC motor behind its gear, driven by a bridge from a supply; all at the output shaft.

Inductance is left out: its time constant is below 0.2 ms in motors of this size.

Source: Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, section 2.3.
"""

from typing import NamedTuple

import numba

COPPER = 0.0039
"""1/K, growth of copper's resistance with temperature."""


class Motor(NamedTuple):
  """Constants, seen from the output shaft."""

  constant: float
  """N m/A, which is V s/rad: torque constant and back-EMF times gear ratio."""
  resistance: float
  """ohm, of winding, brushes and bridge, cold."""
  voltage: float
  """V, of the supply without load at the start."""
  source_resistance: float
  """ohm, of supply and cable."""
  fade: float
  """1/s, share of the voltage that the supply loses."""
  heat_capacity: float
  """J/K, of the winding."""
  cooling_time: float
  """s."""
  derating: float
  """1/K, share of the duty that the firmware takes away as the winding warms."""
  forward: float
  """Share of a positive duty that reaches the winding; 1 of a bridge that is whole."""


@numba.njit
def current(motor: Motor, duty: float, speed: float, rise: float, time: float) -> float:
  """Returns the winding's current [A]: (u V - k w) / (R (1 + a T) + Rs u^2).

  The bridge takes u i from the supply, whose voltage falls by Rs u i.

  Args:
    motor: constants.
    duty: u, -1 to 1.
    speed: w, rad/s.
    rise: T, K above the start.
    time: s since the start.
  """
  source = motor.voltage * (1.0 - motor.fade * time)
  winding = motor.resistance * (1.0 + COPPER * rise)
  return (duty * source - motor.constant * speed) / (
    winding + motor.source_resistance * duty * duty
  )


@numba.njit
def supply(motor: Motor, duty: float, amperes: float, time: float) -> float:
  """Returns the voltage [V] at the servo's plug."""
  return motor.voltage * (1.0 - motor.fade * time) - motor.source_resistance * duty * amperes


@numba.njit
def warmed(motor: Motor, rise: float, amperes: float, step: float) -> float:
  """Returns the winding's rise [K] after a step: C dT/dt = R (1 + a T) i^2 - C T / tau."""
  heat = motor.resistance * (1.0 + COPPER * rise) * amperes * amperes / motor.heat_capacity
  return rise + step * (heat - rise / motor.cooling_time)


def stall_torque(motor: Motor) -> float:
  """Returns the torque [N m] at standstill and full duty: k V / (R + Rs)."""
  return motor.constant * motor.voltage / (motor.resistance + motor.source_resistance)


def no_load_speed(motor: Motor) -> float:
  """Returns the speed [rad/s] at full duty without any torque: V / k."""
  return motor.voltage / motor.constant
