"""What a reference leaves unexplained, expected of logs with the same commands.

What no model of the machine holds shows again where the commands are the same: as late as the
commands and the readings are later. Its readings are noisy, too: a parabola that fits neighbours,
weighted by a normal density of one period (Fan and Gijbels 1996), holds as much of that noise
wherever between two readings it is taken. Linear interpolation halves it half-way, so that a delay
of half a period would be likelier than others by hundreds of nats. Shapes: N samples of all logs, S
of a reference, F times, C channels, P kernel parameters.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import Measured

Array = np.ndarray

_REACH = 5  # readings on either side that count: the next has less than 1e-5 of the weight
_NEAR = (
  2.5  # periods within which a parabola needs three readings: at the ends they are 0, 1 and 2 away
)
_FINE = 8  # times to a period, between which a parabola's values are interpolated
NOISE = 27.0 / (32.0 * np.sqrt(np.pi))
"""Of the readings' mean square that is in what is expected: squares of the kernel of fourth order
that such parabolas are."""
NEIGHBOURS = 81.0 / 128.0 * np.exp(-0.25) / np.sqrt(np.pi)
"""Of the same, the mean product of what is expected of two neighbouring readings."""


class Expectation:
  """A reference's residuals as functions of time since the commands."""

  def __init__(
    self,
    logs: Sequence[Measured],
    likes: Sequence[tuple[Array, Array]],
    baseline: Array,
    *,
    apart: float = 0.0,
  ):
    """Takes the reference.

    Args:
      logs: of which something is expected.
      likes: stamps [S] and residuals [C, S] of the reference's log that is like each.
      baseline: kernel parameters [P] under which the reference leaves that.
      apart: s by which one recording's latency may differ from the others'.
    """
    self.apart = apart
    self._times = [log.time for log in logs]
    self._likes = [
      [
        (late, *_smoothed(_since_command(stamps, baseline, late), rows[part]))
        for late, part in _READ_LATE.items()
        if len(rows[part])
      ]
      for stamps, rows in likes
    ]
    self._last: tuple[tuple[float, ...], Array] | None = None

  def under(self, p: Array) -> Array:
    """Returns what is expected [C, N] under kernel parameters [P]."""
    key = tuple(float(p[INDEX[n]]) for n in _CLOCKS)
    if self._last is None or self._last[0] != key:
      parts = [
        [
          np.interp(_since_command(time, p, late), at, row)
          for late, at, rows in likes
          for row in rows
        ]
        for time, likes in zip(self._times, self._likes, strict=True)
      ]
      self._last = key, np.concatenate([np.array(part) for part in parts], axis=1)
    return self._last[1]


def _smoothed(at: Array, rows: Array) -> tuple[Array, Array]:
  """Returns times [F] and values there [C, F] of parabolas that fit rows [C, S] about each.

  Where fewer than three readings are near, as where some were lost, a value is interpolated.

  Args:
    at: stamps of the readings [S], s, increasing.
    rows: the readings.
  """
  if len(at) < 2 * _REACH:
    return at, rows
  period = float(np.median(np.diff(at)))
  when = np.linspace(at[0], at[-1], max(2, _FINE * round((at[-1] - at[0]) / period)))
  values = np.array([np.interp(when, at, row) for row in rows])
  nearest = np.clip(np.searchsorted(at, when), _REACH, len(at) - _REACH)
  near = nearest[:, None] + np.arange(-_REACH, _REACH)
  apart = (at[near] - when[:, None]) / period
  enough = np.sort(np.abs(apart), axis=1)[:, 2] < _NEAR
  near, apart = near[enough], apart[enough]
  weights = np.exp(-0.5 * apart**2)
  moments = [np.sum(weights * apart**k, axis=1) for k in range(5)]
  normal = np.stack([np.stack(moments[k : k + 3], axis=1) for k in range(3)], axis=1)
  beta = np.linalg.solve(normal, np.broadcast_to(np.eye(3)[:, :1], (len(near), 3, 1)))[..., 0]
  weights = weights * (beta[:, :1] + beta[:, 1:2] * apart + beta[:, 2:] * apart**2)
  values[:, enough] = np.sum(rows[:, near] * weights, axis=2)
  return when, values


_READ_LATE = {"measurement_delay": slice(0, 1), "effort_delay": slice(1, None)}
"""How late readings are of the course and of other channels: beside a late encoder efforts are read
when they were."""
_CLOCKS = ("clock_rate", *_READ_LATE, "command_delay")


def _since_command(stamps: Array, p: Array, read_late: str) -> Array:
  """Returns the time by the commands' clock of what readings with these stamps show.

  Args:
    stamps: [S] s.
    p: kernel parameters [P].
    read_late: the one that says how late they are.
  """
  rate, late, delay = (float(p[INDEX[n]]) for n in ("clock_rate", read_late, "command_delay"))
  return stamps / (1.0 + rate) - late - delay
