"""By how much the commands that a duty answers are late, and the readings' clock is off.

Both by the squares that a law leaves, on grids of delays and rates.
"""

from collections.abc import Callable

import numpy as np

from nerf2real.suite.effects import kind_of

_STEP, _COARSE, _NEAR = 0.001, 0.004, 0.016
"""s between delays that are tried, chosen: firmware and bus work in cycles of a millisecond; in a
first round, a quarter of a period at 60 Hz, faster than position errors change; and how far about
its best delay a second round goes, which a held command's plateau must not leave. Where a clock's
rate is sought, too, they are of the shifts at a log's middle and at its end."""


def best_delay(squares: Callable[[float], float]) -> float:
  """Returns the delay [s] of least squares, within what is plausible of late commands.

  Held commands give plateaus of equal squares: the middle of the best.
  """
  most = kind_of("command_delay").parameter("delay").high
  coarse = np.arange(0.0, most + _COARSE / 2, _COARSE)
  near = coarse[np.argmin([squares(delay) for delay in coarse])]
  fine = np.arange(max(near - _NEAR, 0.0), near + _NEAR + _STEP / 2, _STEP)
  found = np.array([squares(delay) for delay in fine])
  return float(np.median(fine[found <= found.min() * (1.0 + 1e-6)]))


def best_clock(squares: Callable[[float, float], float], longest: float) -> tuple[float, float]:
  """Returns the delay [s] at the beginning of logs and the clock's rate of least squares, within
  what is plausible of both.

  Rates are sought by the shifts that they make at the end of the longest log [s], and delays by
  those at its middle: nearly independent of each other.
  """
  most, fastest = (
    kind_of(kind).parameter(name).high
    for kind, name in (("command_delay", "delay"), ("clock_drift", "rate"))
  )
  ends = np.arange(-fastest * longest, fastest * longest + _NEAR, 2.0 * _NEAR)
  middles = np.arange(ends[0] / 2.0, most + ends[-1] / 2.0, _NEAR)
  step = 2.0 * _NEAR
  while True:
    found = {}
    for end in ends:
      rate = min(max(end / longest, -fastest), fastest)
      for middle in middles:
        delay = middle - 0.5 * rate * longest
        if 0.0 <= delay <= most:
          found[squares(delay, rate), middle, end] = delay, rate
    least = min(found)
    if step <= 2.0 * _STEP:
      return found[least]
    step /= 4.0
    ends = least[2] + step * np.arange(-4, 5)
    middles = least[1] + step / 2.0 * np.arange(-4, 5)
