"""The servo's firmware: a position loop in integers, run a thousand times a second.

The encoder is on the output shaft. Gains are in 1/128 duty steps a count, as servos of this kind
have them.
"""

import math
from typing import NamedTuple

import numba

PERIOD = 1e-3
"""s, between two runs of the loop."""
DENOMINATOR = 128
"""Of the gains."""
RATE_TICKS = 8
"""Runs between the two readings whose difference is the rate: one count in 1 ms is 1.5 rad/s."""


class Loop(NamedTuple):
  """Settings of the firmware and errors of its encoder."""

  counts: int
  """A turn of the output."""
  gain: int
  """1/128 duty steps a count of error."""
  rate_gain: int
  """1/128 duty steps a count of motion in `RATE_TICKS` runs; 0 in a P loop."""
  steps: int
  """Duty steps that are full duty."""
  limit: int
  """Most duty steps."""
  dead_band: int
  """Counts of error that are taken for none."""
  slew: float
  """Counts that the goal moves by at most in a run."""
  offset: float
  """rad, that the encoder reads too much."""
  noise: float
  """Counts, standard deviation of a reading before rounding."""


@numba.njit
def read(loop: Loop, angle: float, noise: float) -> int:
  """Returns the encoder's counts at an angle [rad]; noise: a standard normal draw."""
  return math.floor((angle + loop.offset) * loop.counts / math.tau + loop.noise * noise + 0.5)


@numba.njit
def approached(loop: Loop, profile: float, goal: int) -> float:
  """Returns the goal that the loop follows now, in counts: it moves to the goal within `slew`."""
  return min(max(float(goal), profile - loop.slew), profile + loop.slew)


@numba.njit
def duty(loop: Loop, goal: int, reading: int, older: int) -> int:
  """Returns the duty steps for a goal and two readings, `RATE_TICKS` apart, in counts."""
  error = goal - reading
  if abs(error) <= loop.dead_band:
    error = 0
  wanted = loop.gain * error - loop.rate_gain * (reading - older)
  whole = abs(wanted) // DENOMINATOR  # truncated, as a C compiler does
  return min(whole, loop.limit) if wanted > 0 else -min(whole, loop.limit)


def position_gain(loop: Loop, stall_torque: float) -> float:
  """Returns the torque per error [N m/rad] of a motor with that stall torque [N m]."""
  return loop.gain / DENOMINATOR * loop.counts / math.tau / loop.steps * stall_torque


def speed_gain(loop: Loop, stall_torque: float) -> float:
  """Returns the torque per speed [N m s/rad] of the loop's rate term."""
  a_count = loop.rate_gain / DENOMINATOR / loop.steps * stall_torque
  return a_count * loop.counts / math.tau * RATE_TICKS * PERIOD
