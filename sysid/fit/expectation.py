"""What a reference leaves unexplained, expected of logs with the same commands.

What no model of the machine holds shows again where the commands are the same: as late as the
commands and the readings are later. Shapes: N samples of all logs, C channels, P kernel parameters.
"""

from collections.abc import Sequence

import numpy as np

from nerf2real.sysid.model.kernel import INDEX
from nerf2real.sysid.model.measured import Measured

Array = np.ndarray


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
    self._likes = [(_since_command(stamps, baseline), rows) for (stamps, rows) in likes]
    self._last: tuple[tuple[float, ...], Array] | None = None

  def under(self, p: Array) -> Array:
    """Returns what is expected [C, N] under kernel parameters [P]."""
    key = tuple(float(p[INDEX[n]]) for n in _CLOCKS)
    if self._last is None or self._last[0] != key:
      parts = [
        [np.interp(_since_command(time, p), at, row) for row in rows]
        for time, (at, rows) in zip(self._times, self._likes, strict=True)
      ]
      self._last = key, np.concatenate([np.array(part) for part in parts], axis=1)
    return self._last[1]


_CLOCKS = ("clock_rate", "measurement_delay", "command_delay")


def _since_command(stamps: Array, p: Array) -> Array:
  """Returns the time by the commands' clock of what readings with these stamps show."""
  rate, late, delay = (float(p[INDEX[n]]) for n in _CLOCKS)
  return stamps / (1.0 + rate) - late - delay
