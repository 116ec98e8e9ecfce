"""What a log of another format must be to be usable; of MCAP see `core.robot_logs.reading`."""

import numpy as np

from nerf2real.core.robot_logs.reading import MINIMUM_DURATION, MINIMUM_RATE, Log
from nerf2real.core.robot_logs.streaming import LogError


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
      if values is not None and not np.isfinite(values).all():
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
