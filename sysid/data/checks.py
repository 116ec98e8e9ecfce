"""What a log of another format must be to be usable, and one that stands alone; of MCAP see
`core.robot_logs.reading`."""

from collections.abc import Sequence

import numpy as np

from nerf2real.core.robot_logs.reading import MINIMUM_DURATION, MINIMUM_RATE, Log
from nerf2real.core.robot_logs.streaming import LogError
from nerf2real.sysid.model.measured import block_starts

_FEWEST_BLOCKS = 3
"""Blocks of a log from which on parts of it can be left out and predicted by the others."""


def checked(log: Log) -> Log:
  """Returns a log whose times increase, and that is long, fast and finite enough.

  Raises:
    LogError: it is not.
  """
  for what, series in (("commands", log.commands), ("states", log.states)):
    steps = np.diff(series.stamp)
    if np.any(steps < 0):
      at = int(np.argmax(steps < 0)) + 1
      raise LogError(
        f"{log.name}: time runs backwards by {-steps[at - 1]:.6g} s at reading {at} of the {what}, "
        "expected increasing times."
      )
    for field in ("position", "velocity", "effort"):
      values = getattr(series, field)
      told = slice(None) if values is None else ~np.isnan(values).all(axis=0)
      if values is not None and not np.isfinite(values[:, told]).all():
        raise LogError(f"{log.name}: {what} hold infinite {field}s, expected finite numbers.")
  if log.duration < MINIMUM_DURATION:
    raise LogError(
      f"{log.name} lasts {max(log.duration, 0.0):.3g} s with commands and states, expected at "
      f"least {MINIMUM_DURATION:g} s: record a longer log."
    )
  span = log.states.stamp[-1] - log.states.stamp[0]
  if len(log.states.stamp) < MINIMUM_RATE * span:
    raise LogError(
      f"{log.name} has {len(log.states.stamp)} readings in {span:.3g} s, expected at least "
      f"{MINIMUM_RATE:g} a second: record faster."
    )
  return log


def check_length(logs: Sequence[Log], block_s: float) -> None:
  """Raises a LogError where a single log is too short to predict a part of it by the others.

  Args:
    logs: that are fitted together; of several each is predicted by the others.
    block_s: s of a block of the likelihood.
  """
  if len(logs) != 1 or len(block_starts(logs[0].states.stamp, block_s)) >= _FEWEST_BLOCKS:
    return
  raise LogError(
    f"{logs[0].name} alone is too short: found {np.ptp(logs[0].states.stamp):.3g} s of readings, "
    f"expected at least {_FEWEST_BLOCKS * block_s:g} s: record a longer log, or give several."
  )
